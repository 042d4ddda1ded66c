"""Weights: the newest wins, the late get them at once, and others' are refused."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import zmq
from numpy.typing import NDArray

from apex_bat.transport.messages import Subscription, Waiting, Weights, encode
from apex_bat.transport.security import TransportError, make_keys
from apex_bat.transport.sockets import Connection
from apex_bat.transport.weights import (
    LAPSE_S,
    MAX_SUBSCRIPTION_BYTES,
    RENEW_S,
    REPEAT_S,
    WeightsPublisher,
    WeightsSubscriber,
)
from benchmarks.attacks import ON_WEIGHTS, Target

SHAPES: dict[str, tuple[int, ...]] = {"w": (3, 4), "b": (4,)}


def arrays(value: float, **more: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    return {name: np.full(shape, value, np.float32) for name, shape in SHAPES.items()} | more


@pytest.fixture
def publisher() -> Iterator[WeightsPublisher]:
    one = WeightsPublisher("tcp://127.0.0.1:0")
    yield one
    one.close()


@pytest.fixture
def subscriber(publisher: WeightsPublisher) -> Iterator[WeightsSubscriber]:
    one = WeightsSubscriber(publisher.address, SHAPES)
    yield one
    one.close()


class Timed(NamedTuple):
    """Both ends, by a clock that shows what the test says."""

    now: list[float]
    publisher: WeightsPublisher
    subscriber: WeightsSubscriber


@pytest.fixture
def timed() -> Iterator[Timed]:
    now = [0.0]
    publisher = WeightsPublisher("tcp://127.0.0.1:0", clock=lambda: now[0])
    subscriber = WeightsSubscriber(publisher.address, clock=lambda: now[0])
    yield Timed(now, publisher, subscriber)
    subscriber.close()
    publisher.close()


def arrival(publisher: WeightsPublisher, subscriber: WeightsSubscriber) -> Weights:
    """Returns the next weights that arrive, while the publisher is served."""
    ends_s = time.monotonic() + 10
    while time.monotonic() < ends_s:
        publisher.serve()
        subscriber.wait(0.01)
        if (weights := subscriber.newest()) is not None:
            return weights
    raise AssertionError("no weights came")


def until(publisher: WeightsPublisher, is_so: Callable[[], bool]) -> None:
    """Serves the publisher until something is so."""
    ends_s = time.monotonic() + 10
    while not is_so():
        assert time.monotonic() < ends_s
        publisher.serve()


def test_a_late_subscriber_gets_the_newest_at_once(publisher: WeightsPublisher) -> None:
    for version in range(3):
        publisher.publish(version, version * 25, arrays(version))
    for _ in range(2):
        late = WeightsSubscriber(publisher.address, SHAPES)
        try:
            weights = arrival(publisher, late)
            assert (weights.version, weights.learner_step) == (2, 50)
            np.testing.assert_equal(weights.arrays, arrays(2))
            assert late.newest() is None
        finally:
            late.close()


def test_a_slow_subscriber_finds_the_newest_even_if_a_full_queue_dropped_it(timed: Timed) -> None:
    now, publisher, subscriber = timed
    publisher.publish(0, 0, arrays(0))
    arrival(publisher, subscriber)
    for version in range(1, 100):  # faster than any queue is emptied
        publisher.publish(version, version, arrays(version))
    now[0] = REPEAT_S
    seen = [arrival(publisher, subscriber).version]
    while seen[-1] < 99:
        now[0] += REPEAT_S
        seen.append(arrival(publisher, subscriber).version)
    assert len(seen) < 99
    assert seen == sorted(seen)


def test_weights_that_come_twice_are_new_once(publisher: WeightsPublisher, subscriber: WeightsSubscriber) -> None:
    publisher.publish(1, 1, arrays(1))
    arrival(publisher, subscriber)
    [(identity, known)] = publisher._subscribers.items()
    publisher._send(identity, known, 0.0)
    assert subscriber.wait(10.0)
    assert subscriber.newest() is None


def test_who_has_the_newest_is_sent_nothing_and_who_missed_them_gets_them_with_a_renewal(timed: Timed) -> None:
    now, publisher, subscriber = timed
    publisher.publish(1, 1, arrays(1))
    arrival(publisher, subscriber)
    [known] = publisher._subscribers.values()
    now[0] = REPEAT_S
    subscriber.newest()
    until(publisher, lambda: known.heard_s == REPEAT_S)
    assert known.sent_s == 0.0, "it has them"

    publisher._newest_is = (2, 2)  # as if a full queue had dropped the next ones
    now[0] = 2.0 * REPEAT_S
    subscriber.newest()
    until(publisher, lambda: known.heard_s == 2.0 * REPEAT_S)
    assert known.sent_s == 2.0 * REPEAT_S


def test_whoever_says_so_in_time_finds_the_newest_however_seldom_it_looks(timed: Timed) -> None:
    now, publisher, subscriber = timed
    publisher.publish(0, 0, arrays(0))
    arrival(publisher, subscriber)
    [known] = publisher._subscribers.values()
    for second in range(1, int(3.0 * LAPSE_S)):
        now[0] = float(second)
        subscriber.wait(0.0)
        until(publisher, lambda: known.heard_s == now[0])
        publisher.publish(second, second, arrays(second))
    assert subscriber.wait(10.0)
    newest = [weights.version for _ in range(50) if subscriber.wait(0.05) and (weights := subscriber.newest())]
    assert newest[-1] == 3.0 * LAPSE_S - 1.0


def test_a_learner_resumed_at_a_lower_version_is_followed(
    publisher: WeightsPublisher, subscriber: WeightsSubscriber
) -> None:
    publisher.publish(7, 700, arrays(7))
    arrival(publisher, subscriber)
    publisher.publish(5, 500, arrays(5))
    assert arrival(publisher, subscriber).version == 5


@pytest.mark.parametrize(
    "wrong",
    [
        {"w": np.zeros((3, 4), np.float32)},
        arrays(0, extra=np.zeros(1, np.float32)),
        {"w": np.zeros((4, 3), np.float32), "b": np.zeros(4, np.float32)},
        arrays(np.nan),
    ],
)
def test_weights_of_another_network_are_refused_and_counted(
    publisher: WeightsPublisher, subscriber: WeightsSubscriber, wrong: dict[str, NDArray[np.float32]]
) -> None:
    publisher.publish(1, 1, wrong)
    ends_s = time.monotonic() + 10
    while not subscriber.refusals.total:
        assert time.monotonic() < ends_s
        publisher.serve()
        subscriber.wait(0.01)
        assert subscriber.newest() is None
    publisher.publish(2, 2, arrays(2))
    assert arrival(publisher, subscriber).version == 2


def test_weights_of_another_generation_are_refused(publisher: WeightsPublisher, subscriber: WeightsSubscriber) -> None:
    publisher.publish(1, 1, arrays(1))
    assert arrival(publisher, subscriber).version == 1
    publisher._generation = 3
    publisher.publish(2, 2, arrays(2))
    assert subscriber.wait(10.0)
    assert subscriber.newest() is None
    assert subscriber.refusals.counts == {"generation": 1}


def test_a_subscriber_for_whom_weights_are_too_large_says_so(publisher: WeightsPublisher) -> None:
    now = [0.0]
    subscriber = WeightsSubscriber(publisher.address, max_message_bytes=1000, clock=lambda: now[0])
    try:
        publisher.publish(1, 1, {"w": np.zeros(100_000, np.float32)})

        def renew() -> bool:
            now[0] += RENEW_S
            subscriber.wait(0.01)
            return False

        with pytest.raises(TransportError, match="max_message_mb"):
            until(publisher, renew)
    finally:
        subscriber.close()


def test_arrays_in_any_memory_order_arrive_as_they_are(publisher: WeightsPublisher) -> None:
    turned = np.arange(12, dtype=np.float32).reshape(4, 3).T
    publisher.publish(1, 1, {"w": turned, "b": np.zeros(4, np.float32)})
    late = WeightsSubscriber(publisher.address, SHAPES)
    try:
        np.testing.assert_array_equal(arrival(publisher, late).arrays["w"], turned)
    finally:
        late.close()


def test_weights_travel_encrypted_to_those_with_keys(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    publisher = WeightsPublisher("tcp://127.0.0.1:0", keys=keys)
    friend, stranger = WeightsSubscriber(publisher.address, keys=keys), WeightsSubscriber(publisher.address)
    try:
        publisher.publish(1, 1, arrays(1))
        assert arrival(publisher, friend).version == 1

        def gets_weights() -> bool:
            return stranger.wait(0.05) or stranger.newest() is not None

        with pytest.raises(TransportError, match="authentication refused"):
            until(publisher, gets_weights)
    finally:
        friend.close()
        stranger.close()
        publisher.close()


def test_what_is_no_subscription_of_one_who_knows_the_generation_is_refused_and_counted() -> None:
    publisher = WeightsPublisher("tcp://127.0.0.1:0", generation=7)
    stranger = Connection(zmq.DEALER, publisher.address)
    try:
        publisher.publish(1, 1, arrays(1))
        subscription = bytes(encode(Subscription(-1, 0), 7))
        strange = [bytes(100)], [bytes(encode(Subscription(-1, 0), 8))], [subscription, b"more"]
        for parts in (*strange, [bytes(encode(Waiting("x"), 7))]):
            stranger.socket.send_multipart(parts)
        until(publisher, lambda: publisher.refusals.total == 4)
        assert publisher.refusals.counts == {"foreign": 1, "generation": 1, "parts": 1, "unexpected": 1}
        assert publisher.num_subscribers == 0
        assert not stranger.socket.poll(50), "and nobody of them got weights"
    finally:
        stranger.close()
        publisher.close()


def test_who_subscribes_all_the_time_does_not_multiply_the_broadcasts() -> None:
    publisher = WeightsPublisher("tcp://127.0.0.1:0", clock=lambda: 0.0)
    greedy = Connection(zmq.DEALER, publisher.address)  # one that keeps all that comes
    try:
        publisher.publish(1, 1, arrays(1))
        for _ in range(50):
            greedy.socket.send(encode(Subscription(-1, 0)))
        greedy.socket.send(b"the last")  # counted when all before it have been seen
        until(publisher, lambda: publisher.refusals.total == 1)
        received = 0
        while greedy.socket.poll(50):
            greedy.socket.recv()
            received += 1
        assert received == 1
    finally:
        greedy.close()
        publisher.close()


def test_who_does_not_renew_is_forgotten_and_gets_the_newest_when_it_returns(timed: Timed) -> None:
    now, publisher, subscriber = timed
    publisher.publish(1, 1, arrays(1))
    assert arrival(publisher, subscriber).version == 1
    now[0] = LAPSE_S + 1.0
    publisher.publish(2, 2, arrays(2))
    assert publisher.num_subscribers == 0
    assert arrival(publisher, subscriber).version == 2
    assert publisher.num_subscribers == 1


def test_more_subscribers_than_are_taken_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apex_bat.transport.weights.MAX_SUBSCRIBERS", 1)
    publisher = WeightsPublisher("tcp://127.0.0.1:0")
    publisher.publish(1, 1, arrays(1))
    first, second = (WeightsSubscriber(publisher.address) for _ in range(2))
    try:
        assert arrival(publisher, first).version == 1
        second.wait(0.0)
        until(publisher, lambda: publisher.refusals.counts == {"flood": 1})
        assert second.newest() is None
    finally:
        first.close()
        second.close()
        publisher.close()


def test_a_large_subscription_ends_the_connection(publisher: WeightsPublisher) -> None:
    stranger = Connection(zmq.DEALER, publisher.address)
    try:
        stranger.socket.send(bytes(MAX_SUBSCRIPTION_BYTES + 1))
        until(publisher, lambda: publisher._listener.num_ended > 0)
        assert publisher.refusals.total == 0
    finally:
        stranger.close()


@pytest.mark.slow
def test_a_publisher_goes_on_whatever_strangers_do() -> None:
    publisher = WeightsPublisher("tcp://127.0.0.1:0", generation=7)
    subscriber = WeightsSubscriber(publisher.address, generation=7)
    attackers = multiprocessing.get_context("spawn").Process(target=attack, args=(publisher.address,), daemon=True)
    attackers.start()
    longest_s, ends_s, version = 0.0, time.monotonic() + 30, 0
    try:
        while time.monotonic() < ends_s:
            begun_s = time.monotonic()
            publisher.serve()
            longest_s = max(longest_s, time.monotonic() - begun_s)
            if subscriber.newest() is not None or not version:
                version += 1
                publisher.publish(version, version, arrays(version))
            subscriber.wait(0.005)
        assert publisher.refusals.total > 1000
        assert version > 1000
        assert longest_s < 2.0
    finally:
        attackers.kill()
        attackers.join()
        subscriber.close()
        publisher.close()


def attack(address: str) -> None:
    """A process: strangers make every attack on a publisher, 100 rounds a second, and half of them come and go."""
    while True:
        shots = [make(Target(address, 0, MAX_SUBSCRIPTION_BYTES, zmq.DEALER)) for make in ON_WEIGHTS.values()]
        topics: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XSUB)
        topics.setsockopt(zmq.LINGER, 0)
        topics.connect(address)
        for number in range(200):
            for shoot in shots:
                with suppress(OSError):
                    shoot()
            with suppress(zmq.Again):
                topics.send(b"\x01" + number.to_bytes(2, "big") * 450, zmq.NOBLOCK)
            time.sleep(0.01)
        topics.close()


def test_a_subscriber_follows_a_publisher_to_another_address_and_generation_at_once(
    publisher: WeightsPublisher,
) -> None:
    subscriber = WeightsSubscriber(publisher.address, SHAPES, clock=lambda: 0.0)
    publisher.publish(1, 25, arrays(1))
    assert arrival(publisher, subscriber).version == 1
    successor = WeightsPublisher("tcp://127.0.0.1:0", generation=7)
    try:
        successor.publish(2, 50, arrays(2))
        subscriber.redirect(successor.address, 7)
        assert arrival(successor, subscriber).version == 2
        publisher.publish(3, 75, arrays(3))  # what the former one still says is not heard
        successor.publish(4, 100, arrays(4))
        assert arrival(successor, subscriber).version == 4
    finally:
        successor.close()
        subscriber.close()
