"""Orders on standard input: addresses, keys, news, and what is none."""

import logging
import threading

import pytest

from apex_bat.roles.orders import MAX_LINE_BYTES, STOP, GivenKeys, StandingOrders, line_of
from apex_bat.roles.plan import Addresses
from apex_bat.transport.security import TransportError, new_keys

FIRST = Addresses("tcp://10.0.0.1:1", "tcp://10.0.0.1:2", "tcp://10.0.0.1:3", replay_generation=5)
NEXT = Addresses("tcp://10.0.0.2:1", "tcp://10.0.0.1:2", "tcp://10.0.0.1:3", replay_generation=6)


def test_first_orders_bring_addresses_and_keys() -> None:
    orders, keys = StandingOrders(), new_keys()
    orders.heed(line_of(FIRST, keys))
    assert orders.first() == FIRST
    assert orders.keys == keys
    assert orders.moved() is None, "where it begins is no news"


def test_later_orders_are_news_once_and_leave_the_keys() -> None:
    orders, keys = StandingOrders(), new_keys().of_client()
    orders.heed(line_of(FIRST, keys) + line_of(FIRST) + line_of(NEXT))
    assert orders.first() == FIRST
    assert orders.moved() == NEXT
    assert orders.moved() is None
    assert orders.keys == keys
    assert keys.server_secret is None


def test_an_end_without_stop_makes_an_orphan() -> None:
    orders = StandingOrders()
    orders.heed(line_of(FIRST) + line_of(NEXT))
    assert orders.is_orphan
    orders.heed(STOP)
    assert not orders.is_orphan
    assert orders.first() == FIRST
    assert orders.moved() == NEXT


def test_bytes_may_come_in_any_pieces() -> None:
    orders = StandingOrders()
    for byte in line_of(FIRST, new_keys()):
        orders.heed(bytes([byte]))
    assert orders.first() == FIRST


@pytest.mark.parametrize("line", [b"\n", b"{}\n", b"\xff\xfe\n", b'{"addresses": 3}\n', b"[" * 5000 + b"\n"])
def test_a_line_that_is_no_order_changes_nothing_and_is_not_repeated_in_the_log(
    line: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    orders = StandingOrders()
    orders.heed(line + line_of(FIRST))
    assert orders.first() == FIRST
    assert "is no order" in caplog.text
    assert "addresses" not in caplog.text


def test_a_line_without_end_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    orders = StandingOrders()
    with caplog.at_level(logging.ERROR):
        orders.heed(b"x" * (MAX_LINE_BYTES + 1))
    assert "left out" in caplog.text
    orders.heed(line_of(FIRST))
    assert orders.first() == FIRST


def test_a_role_without_orders_says_so() -> None:
    with pytest.raises(TransportError, match="no addresses came"):
        StandingOrders().first(timeout_s=0.0)


def test_a_secret_is_in_no_text_of_the_keys() -> None:
    keys = new_keys()
    given = GivenKeys("a", "b", keys.client_secret.decode(), None, [])
    assert keys.client_secret.decode() not in f"{given!r} {given}"


def test_news_that_comes_while_news_is_taken_is_not_lost() -> None:
    """A swap of two names would lose what is written between its two halves."""
    orders = StandingOrders()
    orders.heed(line_of(FIRST))
    ended, taken = threading.Event(), []
    last = 500

    def take() -> None:
        while not ended.is_set():
            if (news := orders.moved()) is not None:
                taken.append(news.replay_generation)

    thread = threading.Thread(target=take)
    thread.start()
    for generation in range(last + 1):
        orders.heed(line_of(Addresses("a", "b", "c", replay_generation=generation)))
    ended.set()
    thread.join()
    if (news := orders.moved()) is not None:
        taken.append(news.replay_generation)
    assert taken[-1] == last
    assert taken == sorted(set(taken)), "each once, in their order"
