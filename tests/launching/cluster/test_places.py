"""Places for keepers: found in advance, away from doubtful nodes, and taken from actors when others lack one."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Collection

import pytest

from apex_bat.launching.cluster import fleet as looking
from apex_bat.launching.cluster import places as module
from apex_bat.launching.cluster.fleet import Fleet
from apex_bat.launching.cluster.kept import Fate
from apex_bat.launching.cluster.placed import Placed
from apex_bat.roles.plan import Role
from tests.launching.cluster.stage import ACTOR, CONFIG, LEARNER, REPLAY, Host, Stage, until


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Looks at keepers and asks nodes many times a second, and calls those silent that are so for a third of one."""
    monkeypatch.setattr(looking, "LOOK_S", 0.02)
    monkeypatch.setattr(module, "SILENT_S", 0.3)
    monkeypatch.setattr(module, "ASK_AFTER_S", 0.3)
    monkeypatch.setattr(module, "ASK_PERIOD_S", 0.05)


def work(fleet: Fleet, *roles: Role) -> list[Placed]:
    """Starts roles and waits until all work."""
    placed = [fleet.start(role, 0, 0) for role in roles]
    until(lambda: all(each.pid for each in placed))
    return placed


def until_next(fleet: Fleet, role: Role) -> None:
    """Waits until the next place of a role is found."""
    until(lambda: (kept := fleet._kept[role.name]).next is not None and kept.next.site is not None)


def test_the_next_place_of_a_lost_server_is_found_while_the_former_life_may_still_be_ending(
    fleet: Fleet, stage: Stage
) -> None:
    replay, *_ = work(fleet, REPLAY, LEARNER, ACTOR)
    stage.hosts[0].is_lost = True
    until_next(fleet, REPLAY)
    assert replay.poll() is None, "an orphan has a second for its last files"
    until(replay.poll)
    assert not stage.hosts[3].starts
    again = fleet.start(REPLAY, 1, 0)
    until(lambda: again.pid)
    assert len(stage.hosts[3].starts) == 1
    assert len(stage.hosts) == 4
    assert stage.hosts[3].away_from == "", "the cluster has said so: it offers no place on a node that is gone"
    until(lambda: stage.hosts[1].news)
    address = stage.hosts[1].news[-1].addresses.replay
    assert address.startswith("tcp://10.0.0.4:"), "the others hear of the place in which it lives"


def test_a_place_in_advance_that_is_lost_as_well_is_replaced(fleet: Fleet, stage: Stage) -> None:
    replay, _ = work(fleet, REPLAY, LEARNER)

    def lose(host: Host) -> None:
        host.is_lost = len(stage.hosts) == 2

    stage.prepare = lose
    stage.hosts[0].is_lost = True
    until(replay.poll)
    again = fleet.start(REPLAY, 1, 0)
    until(lambda: again.pid)
    assert len(stage.hosts[-1].starts) == 1


@pytest.mark.usefixtures("soon")
def test_a_place_in_advance_whose_keeper_fails_costs_the_present_life_nothing(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PATIENCE_S", 0.3)
    _, learner = work(fleet, REPLAY, LEARNER)

    def failing(host: Host) -> None:
        host.failing, host.error = "site", OSError(errno.ENOMEM, "Cannot allocate memory")

    stage.prepare = failing
    stage.hosts[1].is_silent = True
    until(lambda: len(stage.hosts) > 3)
    assert learner.poll() is None
    stage.hosts[1].is_silent = False
    until(lambda: fleet._kept["learner"].next is None)
    assert learner.poll() is None
    assert learner.pid


@pytest.mark.usefixtures("soon")
def test_a_silent_server_gets_its_next_place_away_from_its_node_before_its_lease_ends(
    fleet: Fleet, stage: Stage
) -> None:
    _, learner, _ = work(fleet, REPLAY, LEARNER, ACTOR)
    stage.hosts[1].is_silent = True
    until_next(fleet, LEARNER)
    assert learner.poll() is None
    assert stage.hosts[3].away_from == "node2"
    until(lambda: stage.hosts[3].prepared == [LEARNER])
    until(learner.poll)
    assert not stage.hosts[3].starts, "nobody twice"
    again = fleet.start(LEARNER, 1, 0)
    until(lambda: again.pid)
    assert [len(host.starts) for host in stage.hosts] == [1, 1, 1, 1]
    assert not any(host.prepared for host in stage.hosts[:3])
    assert stage.hosts[1].is_dismissed


@pytest.mark.usefixtures("soon")
def test_a_server_that_is_heard_again_stays_and_gives_its_next_place_back(fleet: Fleet, stage: Stage) -> None:
    replay, *_ = work(fleet, REPLAY, LEARNER)
    stage.hosts[0].is_silent = True
    until_next(fleet, REPLAY)
    stage.hosts[0].is_silent = False
    until(lambda: stage.hosts[2].is_dismissed)
    assert replay.poll() is None
    assert not stage.hosts[2].starts


def test_an_actor_gets_no_place_in_advance_but_one_away_from_its_node(fleet: Fleet, stage: Stage) -> None:
    *_, actor = work(fleet, REPLAY, LEARNER, ACTOR)
    stage.hosts[2].is_silent = True
    until(actor.poll)
    assert len(stage.hosts) == 3
    again = fleet.start(ACTOR, 1, 0)
    until(lambda: again.pid)
    assert stage.hosts[3].away_from == "node3"


@pytest.mark.usefixtures("soon")
def test_a_node_that_refuses_connections_again_and_again_has_lost_its_roles(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    def refusing(nodes: Collection[str]) -> dict[str, str]:
        asked.append(nodes)
        return dict.fromkeys(nodes, "refusing")

    monkeypatch.setattr(stage, "fates", refusing)
    *_, actor = work(fleet, REPLAY, LEARNER, ACTOR)
    stage.hosts[2].is_silent = True
    begun_s = time.monotonic()
    until(actor.poll)
    assert time.monotonic() - begun_s < CONFIG.cluster.lease_s, "its lease need not be waited for"
    assert asked == [{"node3"}] * module.MOST_REFUSALS
    ended = actor.poll()
    assert ended is not None
    assert ended.is_lost
    assert "refuses connections" in ended.detail


@pytest.mark.usefixtures("soon")
def test_a_node_that_refuses_now_and_then_or_is_heard_is_believed_to_live(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    def now_and_then(nodes: Collection[str]) -> dict[str, str]:
        asked.append(nodes)
        return dict.fromkeys(nodes, "unknown" if len(asked) % module.MOST_REFUSALS == 0 else "refusing")

    monkeypatch.setattr(stage, "fates", now_and_then)
    *_, actor = work(fleet, REPLAY, LEARNER, ACTOR)
    stage.hosts[2].is_silent = True
    until(lambda: len(asked) > 4 * module.MOST_REFUSALS)
    assert actor.poll() is None
    stage.hosts[2].is_silent = False
    time.sleep(0.5)
    num_asked = len(asked)
    time.sleep(0.5)
    assert len(asked) == num_asked, "who is heard is not asked for"


@pytest.mark.parametrize("fate", ["removed", "unknown"])
def test_a_role_waits_for_a_place_away_from_a_node_until_that_is_removed_or_patience_ends(
    fate: Fate, fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "OTHERWISE_S", 3.0 if fate == "unknown" else 60.0)
    _, learner = work(fleet, REPLAY, LEARNER)

    def full(host: Host) -> None:
        host.has_place = not host.away_from

    stage.prepare = full
    stage.hosts[1].is_silent = True
    until(learner.poll)
    again = fleet.start(LEARNER, 1, 0)
    begun_s = time.monotonic()
    time.sleep(0.3)
    assert not again.pid
    if fate == "removed":
        monkeypatch.setattr(module, "OTHERWISE_S", 1.0)
        stage.fate["node2"] = fate
    until(lambda: again.pid)
    assert (time.monotonic() - begun_s > 2.5) == (fate == "unknown"), "half the patience, if there is nothing to avoid"
    assert stage.hosts[-1].away_from == ""
    assert all(host.is_dismissed for host in stage.hosts if host.away_from), "or it would hold a place for nobody"


def test_a_role_whose_reserved_place_does_not_come_back_takes_another(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "OTHERWISE_S", 0.5)

    def without_group(host: Host) -> None:
        host.has_place = not host.is_reserved

    *_, actor = work(fleet, REPLAY, LEARNER, ACTOR)
    stage.prepare, stage.has_room, stage.hosts[2].is_lost = without_group, False, True
    until(actor.poll)
    again, further = fleet.start(ACTOR, 1, 0), fleet.start(Role("actor", 1), 0, 0)
    until(lambda: again.pid)
    hosts = [host for host in stage.hosts[3:] if host.role == ACTOR]
    assert [host.is_reserved for host in hosts] == [True, False]
    assert hosts[0].is_dismissed
    assert not further.pid
    assert len([host for host in stage.hosts if host.role.number == 1]) == 1, "nothing is reserved for it: it waits"


def test_a_keeper_that_is_slow_to_start_in_its_reserved_place_is_waited_for(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "OTHERWISE_S", 0.1)
    monkeypatch.setattr(module, "ASK_PERIOD_S", 0.02)

    def slow(host: Host) -> None:
        host.has_place = False

    stage.prepare = slow
    replay, learner = (fleet.start(role, 0, 0) for role in (REPLAY, LEARNER))
    time.sleep(1.0)
    assert len(stage.hosts) == 2, "the group has its places: nothing else is there to ask for"
    for host in stage.hosts:
        host.has_place = True
    until(lambda: replay.pid and learner.pid)


def test_a_keeper_that_was_ended_here_is_not_known_to_be_lost(fleet: Fleet, stage: Stage) -> None:
    *_, actor = work(fleet, REPLAY, LEARNER, ACTOR)
    with fleet._lock:
        fleet._kept["actor-0"].lose("its node refuses connections")
    stage.hosts[2].is_lost = True
    until(actor.poll)
    until(lambda: not fleet._kept["actor-0"].under_way)
    again = fleet.start(ACTOR, 1, 0)
    until(lambda: again.pid)
    assert stage.hosts[3].away_from == "node3", "the cluster would offer the same node"


def test_actors_leave_their_places_to_a_learner_that_finds_none(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PATIENCE_S", 0.2)
    actors = [Role("actor", number) for number in range(3)]
    placed = {role: fleet.start(role, 0, 0) for role in (REPLAY, LEARNER, *actors)}
    until(lambda: all(each.pid for each in placed.values()))

    def without_place(host: Host) -> None:
        host.has_place = False

    stage.prepare, stage.has_room, stage.hosts[1].is_lost = without_place, False, True
    until(placed[LEARNER].poll)
    placed[LEARNER] = fleet.start(LEARNER, 1, 0)
    until(placed[actors[2]].poll)
    ended = placed[actors[2]].poll()
    assert ended is not None
    assert ended.is_lost
    assert stage.hosts[4].is_dismissed
    waits = fleet.start(actors[2], 1, 0)
    until(lambda: stage.hosts[-1].role is LEARNER)
    num_hosts = len(stage.hosts)
    assert placed[actors[0]].poll() is None or placed[actors[1]].poll() is not None, (
        "one after the other, the last first"
    )

    stage.prepare, stage.has_room, stage.hosts[-1].has_place = (lambda _: None), True, True
    until(lambda: placed[LEARNER].pid)
    assert num_hosts == 6, "no place was asked for an actor meanwhile"
    until(lambda: waits.pid)


def test_the_first_actor_keeps_its_place_which_nobody_else_could_have(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROOM_PERIOD_S", 0.05)
    placed = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER, ACTOR)]
    until(lambda: all(each.pid for each in placed))
    asked: list[bool] = []

    def short() -> bool:
        asked.append(True)
        return True

    def without_place(host: Host) -> None:
        host.has_place = False

    monkeypatch.setattr(module, "PATIENCE_S", 0.0)
    stage.prepare, stage.is_short = without_place, short  # type: ignore[method-assign]
    fleet.start(Role("evaluator", 0), 0, 0)
    until(lambda: len(asked) > 3)
    assert placed[2].poll() is None
    assert not stage.hosts[2].is_dismissed


def test_a_slow_head_of_the_cluster_holds_up_no_look(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, answered = threading.Event(), threading.Event()

    def slow() -> bool:
        asked.set()
        answered.wait(20.0)
        return False

    stage.is_short = slow  # type: ignore[method-assign]
    placed = [fleet.start(role, 0, 0) for role in (REPLAY, ACTOR)]
    until(lambda: len(stage.hosts) == 2 and stage.hosts[0]._looks)

    def without_place(host: Host) -> None:
        host.has_place = False

    stage.prepare = without_place
    monkeypatch.setattr(module, "PATIENCE_S", 0.0)
    fleet.start(LEARNER, 0, 0)
    assert asked.wait(20.0)
    looks = stage.hosts[0]._looks
    until(lambda: stage.hosts[0]._looks > looks + 2)
    assert fleet.is_waiting, "and nobody waits for the lock"
    assert placed[0].poll() is None
    answered.set()


def test_the_cluster_is_not_asked_at_every_look_whether_it_is_short(
    fleet: Fleet, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PATIENCE_S", 0.0)
    asked_s: list[float] = []

    def note() -> bool:
        asked_s.append(time.monotonic())
        return False

    def without_place(host: Host) -> None:
        host.has_place = False

    stage.prepare, stage.is_short = without_place, note  # type: ignore[method-assign]
    fleet.start(LEARNER, 0, 0)
    until(lambda: len(asked_s) == 2)
    assert asked_s[1] - asked_s[0] > 0.9 * module.ROOM_PERIOD_S
