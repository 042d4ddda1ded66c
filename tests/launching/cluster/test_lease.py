"""The lease: the role has ended before its replacement begins, whatever the network does with the looks."""

import random
import time

import pytest

from apex_bat.launching.cluster.lease import IMPORTS_S, MARGIN_S, YOUNG_S, Hearing, Lease, clock_s
from apex_bat.roles.orders import ORPHANED_S


class Clock:
    """Shows what the test says."""

    def __init__(self, now_s: float = 0.0) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s


def test_looks_prolong_the_lease_from_when_the_answer_was_given() -> None:
    clock = Clock()
    lease = Lease(10.0, clock)
    first = lease.answer(0)
    clock.now_s = 9.0
    lease.answer(first)  # the launcher has seen what was given at 0
    clock.now_s = 10.0
    assert lease.has_lapsed, "the answer at 0 was seen, the one at 9 not yet"


def test_a_look_that_was_under_way_for_long_prolongs_nothing() -> None:
    clock = Clock()
    lease = Lease(10.0, clock)
    seen = lease.answer(0)
    clock.now_s = 5.0
    seen = lease.answer(seen)
    clock.now_s = 100.0  # a cut; now the network delivers what was sent at its beginning
    lease.answer(seen)
    assert lease.has_lapsed


def test_it_lives_again_when_the_launcher_answers_again() -> None:
    clock = Clock()
    lease = Lease(10.0, clock)
    clock.now_s = 50.0
    assert lease.has_lapsed
    late = lease.answer(0)
    assert lease.has_lapsed, "one look says nothing: it may be old"
    lease.answer(late)
    assert not lease.has_lapsed


def test_an_unknown_answer_prolongs_nothing() -> None:
    clock = Clock()
    lease = Lease(10.0, clock)
    clock.now_s = 20.0
    lease.answer(999)
    assert lease.has_lapsed


def test_the_launcher_never_gives_up_a_role_whose_lease_still_runs() -> None:
    """Random delays and losses of looks and answers, and clocks that show different times."""
    for seed in range(200):
        draw = random.Random(seed)  # noqa: S311  # no secret
        keeper_clock = Clock(draw.uniform(0.0, 1e6))
        offset_s = -keeper_clock.now_s
        lease, hearing = Lease(5.0, keeper_clock), Hearing(5.0)
        hearing.take(0.0, lease.answer(0))
        messages: list[tuple[float, str, int]] = []  # when it arrives, where, which answer it names or is
        now_s = 0.0
        while now_s < 60.0:
            now_s += 0.1
            keeper_clock.now_s = now_s - offset_s
            if draw.random() < 0.3:
                messages.append((now_s + draw.expovariate(0.5), "keeper", hearing.seen))
            due = sorted(each for each in messages if each[0] <= now_s)
            messages = [each for each in messages if each[0] > now_s]
            for _, where, number in due:
                if where == "launcher":
                    if number > hearing.seen:
                        hearing.take(now_s, number)
                elif draw.random() < 0.7:
                    messages.append((now_s + draw.expovariate(0.5), "launcher", lease.answer(number)))
            if hearing.is_over(now_s):
                assert lease.has_lapsed, seed


def test_the_launcher_waits_a_moment_beyond_the_lease() -> None:
    hearing = Hearing(5.0)
    assert not hearing.is_over(1e9), "never heard: it has not begun"
    hearing.take(100.0, 1)
    assert not hearing.is_over(105.0)
    assert hearing.is_over(105.0 + MARGIN_S)


def test_nothing_runs_on_a_lost_keeper_after_the_grace_of_what_was_started_there() -> None:
    hearing = Hearing(5.0)
    assert hearing.gone_s() == float("inf")
    hearing.take_loss(100.0)
    hearing.take_loss(200.0)
    assert hearing.gone_s() == 100.0, "nothing was started"
    hearing.ordered_s = 100.0 - YOUNG_S
    assert hearing.gone_s() == 100.0 + ORPHANED_S + MARGIN_S
    hearing.ordered_s = 99.0
    assert hearing.gone_s() == 100.0 + IMPORTS_S + ORPHANED_S + MARGIN_S, "it may still import its libraries"


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="this system has no such clock")
def test_the_lease_goes_on_while_the_machine_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "clock_gettime", {time.CLOCK_BOOTTIME: 7.0}.__getitem__)
    assert clock_s() == 7.0
