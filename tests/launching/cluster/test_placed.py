"""One life of a role, as the supervisor sees it: what its keeper says, and what follows when that is lost."""

from __future__ import annotations

from apex_bat.config import load
from apex_bat.launching.cluster.keeper import Site
from apex_bat.launching.cluster.lease import IMPORTS_S, MARGIN_S, YOUNG_S, Hearing
from apex_bat.launching.cluster.placed import Placed
from apex_bat.roles.orders import ORPHANED_S
from apex_bat.roles.plan import Role

REPLAY, LEARNER, ACTOR = Role("replay", 0), Role("learner", 0), Role("actor", 0)
CONFIG = load(None, ["cluster.lease_s=2.0"])
GONE_S = ORPHANED_S + MARGIN_S


class Clock:
    """Shows what the test says."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def placed_on(role: Role, clock: Clock) -> tuple[Placed, list[str]]:
    hearing, orders = Hearing(20.0), list[str]()
    placed = Placed(role, 1, "1 CPU", CONFIG, hearing, orders.append, clock)
    clock.now_s = -YOUNG_S
    placed.take_site(Site("h", "10.0.0.1", 5000, ""))
    placed.begin()
    placed.take_start(7)
    clock.now_s = 0.0
    hearing.take(0.0, 1)
    return placed, orders


def test_a_writer_whose_keeper_died_has_a_moment_to_write_its_last_files() -> None:
    for role, wait_s in ((LEARNER, GONE_S), (REPLAY, GONE_S), (ACTOR, 0.0)):
        clock = Clock()
        placed, _ = placed_on(role, clock)
        clock.now_s = lost_s = 15.0  # heard last at 0
        placed.take_loss("it died")
        clock.now_s = lost_s + wait_s - 1e-3
        assert (placed.poll() is None) == (wait_s > 0.0)
        clock.now_s = lost_s + wait_s
        ended = placed.poll()
        assert ended is not None
        assert ended.is_lost


def test_a_lost_keeper_enforces_no_lease() -> None:
    clock = Clock()
    placed, _ = placed_on(LEARNER, clock)
    clock.now_s = 19.0
    placed.take_loss("it died")
    clock.now_s = 19.0 + ORPHANED_S + MARGIN_S / 2
    assert placed.poll() is None, "the lease, of 2 s by the settings, says nothing"
    clock.now_s += MARGIN_S / 2
    assert placed.poll() is not None


def test_a_life_that_has_not_begun_waits_for_what_the_former_one_may_have_left_on_the_same_keeper() -> None:
    clock, hearing = Clock(), Hearing(20.0)
    former = Placed(LEARNER, 1, "1 CPU", CONFIG, hearing, lambda _: None, clock)
    former.begin()
    former.take_error(OSError("its host does not answer"))  # the order may have come through
    hearing.take(0.0, 1)
    placed = Placed(LEARNER, 2, "1 CPU", CONFIG, hearing, lambda _: None, clock)
    placed.take_loss("it died")
    clock.now_s = GONE_S
    assert placed.poll() is None, "what was ordered just before the loss may still import its libraries"
    clock.now_s = IMPORTS_S + GONE_S
    assert placed.poll() is not None


def test_a_role_without_a_place_ends_when_it_is_asked_to() -> None:
    for end in (Placed.stop, Placed.kill):
        placed = Placed(ACTOR, 1, "1 CPU", CONFIG, Hearing(20.0), lambda _: None)
        end(placed)
        assert placed.poll() is not None
    placed, orders = placed_on(ACTOR, Clock())
    placed.stop()
    placed.kill()
    assert orders == ["stop", "kill"]
    assert placed.poll() is None, "until its keeper says so"


def test_a_keeper_that_never_worked_counts_as_a_failure_of_the_role() -> None:
    placed = Placed(ACTOR, 1, "1 CPU", CONFIG, Hearing(20.0), lambda _: None)
    placed.take_loss("cannot import")
    ended = placed.poll()
    assert ended is not None
    assert (ended.code, ended.is_lost) == (1, False)
