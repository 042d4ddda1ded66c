"""Roles on hosts that a test plays: places, moves, losses, and nobody twice."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from apex_bat.config import load
from apex_bat.launching.cluster import places as module
from apex_bat.launching.cluster.fleet import Fleet
from apex_bat.launching.cluster.keeper import Look, Site
from apex_bat.launching.cluster.kept import MOST_FAILED_STARTS, LostError
from apex_bat.launching.cluster.lease import Hearing
from apex_bat.launching.cluster.placed import Placed
from apex_bat.launching.supervisor import USELESS
from apex_bat.roles.orders import ORPHANED_S, Orders
from apex_bat.roles.plan import Role, read_addresses
from apex_bat.roles.process import ADDRESSES
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import new_keys

REPLAY, LEARNER, ACTOR = Role("replay", 0), Role("learner", 0), Role("actor", 0)
CONFIG = load(None, ["cluster.lease_s=2.0", "launch.grace_s=1.0"])


class Call(NamedTuple):
    """A call that is under way."""

    host: Host
    method: str
    given: tuple[object, ...]

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


class Host:
    """A keeper played by the test."""

    def __init__(self, number: int, role: Role) -> None:
        self.number, self.role = number, role
        self.has_place = True
        self.is_lost = self.is_silent = self.is_dismissed = False
        self.problem = ""
        self.pids_differ = True
        self.error: Exception | None = None
        self.failing = ""
        """The method that is answered by `error`, while there is one."""
        self.starts: list[Orders] = []
        self.news: list[Orders] = []
        self.ended = False
        self._looks = self._life = 0

    def call(self, method: str, *given: object) -> object:
        return Call(self, method, given)

    def dismiss(self) -> None:
        self.is_dismissed = True

    def answer(self, method: str, given: tuple[object, ...]) -> object:
        if method == "site":
            self._port = 5000 + 100 * self.number + len(self.starts)
            return Site(f"host{self.number}", f"10.0.0.{self.number}", self._port, self.problem)
        if method == "start":
            life, orders = given[0], given[5]
            assert isinstance(life, int)
            self._life = life
            self.starts.append(_orders(orders))
            self.ended = False
            return self._pid()
        if method == "look":
            self._looks += 1
            if given[1] is not None:
                self.news.append(_orders(given[1]))
            return Look(self._looks, self._life or -1, self._pid(), self.ended, 4, "it ended")
        return None

    def _pid(self) -> int:
        return 1000 * (self.number if self.pids_differ else 1) + len(self.starts)


def _orders(line: object) -> Orders:
    assert isinstance(line, bytes)
    return msgspec.json.decode(line, type=Orders)


class Stage:
    """Makes hosts, one for each call."""

    def __init__(self) -> None:
        self.hosts: list[Host] = []
        self.prepare: Callable[[Host], None] = lambda _: None
        self.has_room = True

    def is_short(self) -> bool:
        return not self.has_room

    def asks(self, role: Role) -> str:
        return f"1 CPU for {role.name}"

    def place(self, role: Role) -> Host:
        host = Host(len(self.hosts) + 1, role)
        self.prepare(host)
        self.hosts.append(host)
        return host

    def answers(self, tickets: list[object], timeout_s: float) -> Iterator[tuple[object, object]]:
        time.sleep(timeout_s / 10)
        for ticket in tickets:
            assert isinstance(ticket, Call)
            host, method, given = ticket
            if host.is_lost:
                yield ticket, LostError("the node died")
            elif host.error is not None and method == host.failing:
                yield ticket, host.error
            elif host.has_place and not host.is_silent:
                yield ticket, host.answer(method, given)


@pytest.fixture
def stage() -> Stage:
    return Stage()


@pytest.fixture
def fleet(stage: Stage, tmp_path: Path) -> Iterator[Fleet]:
    collector = ReportCollector("tcp://127.0.0.1:0", keys=new_keys())
    with Fleet(CONFIG, tmp_path, collector, new_keys(), stage) as one:
        yield one
    collector.close()


def until(condition: Callable[[], object]) -> None:
    ends_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < ends_s, "it did not happen within 20 s"
        time.sleep(0.01)


def test_roles_wait_for_places_and_are_told_where_the_servers_are(fleet: Fleet, stage: Stage) -> None:
    def without_place(host: Host) -> None:
        host.has_place = host.role is not REPLAY

    stage.prepare = without_place
    placed = [fleet.start(role, 3, 50) for role in (REPLAY, LEARNER, ACTOR)]
    until(lambda: len(stage.hosts) == 3)
    replay, learner, actor = stage.hosts
    until(lambda: "places of replay and learner" in placed[2].waiting)
    assert placed[0].waiting == "waiting for a place in the cluster: asks 1 CPU for replay"
    assert not actor.starts
    replay.has_place = True
    until(lambda: all(each.pid for each in placed))
    (first,) = actor.starts
    assert first.addresses.replay == "tcp://10.0.0.1:5100"
    assert first.addresses.weights == "tcp://10.0.0.2:5200"
    assert first.keys is not None
    assert first.keys.server_secret is None, "an actor needs no secret of a server"
    assert learner.starts[0].keys is not None
    assert learner.starts[0].keys.server_secret is not None
    generations = {host.starts[0].addresses.reports_generation for host in stage.hosts}
    assert len(generations) == 3, "each life reports with a number of its own"


def test_a_role_that_failed_starts_again_where_it_was_and_the_others_hear_where(fleet: Fleet, stage: Stage) -> None:
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER, ACTOR)]
    until(lambda: all(each.pid for each in first))
    replay, learner, actor = stage.hosts
    replay.ended = True
    until(first[0].poll)
    ended = first[0].poll()
    assert ended is not None
    assert (ended.code, ended.detail, ended.is_lost) == (4, "it ended", False)
    again = fleet.start(REPLAY, 1, 0)
    until(lambda: again.pid and actor.news and learner.news)
    assert len(stage.hosts) == 3, "no new place"
    assert again.poll() is None, "what is said of the former life does not count"
    for host in (actor, learner):
        assert host.news[0].addresses.replay == "tcp://10.0.0.1:5101"
        assert host.news[0].addresses.replay_generation != host.starts[0].addresses.replay_generation
        assert host.news[0].addresses.reports_generation == host.starts[0].addresses.reports_generation


def test_a_role_on_a_lost_host_gets_another_place(fleet: Fleet, stage: Stage) -> None:
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER, ACTOR)]
    until(lambda: all(each.pid for each in first))
    stage.hosts[2].is_lost = True
    until(first[2].poll)
    ended = first[2].poll()
    assert ended is not None
    assert ended.is_lost
    again = fleet.start(ACTOR, 1, 0)
    until(lambda: again.pid)
    assert len(stage.hosts) == 4
    assert stage.hosts[2].is_dismissed


def test_the_next_place_of_a_lost_server_is_found_while_the_former_life_may_still_be_ending(
    fleet: Fleet, stage: Stage
) -> None:
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER, ACTOR)]
    until(lambda: all(each.pid for each in first))
    stage.hosts[0].is_lost = True
    until(lambda: len(stage.hosts) == 4 and fleet._kept["replay"].site is not None)
    assert first[0].poll() is None, "an orphan has a second for its last files"
    until(first[0].poll)
    assert not stage.hosts[3].starts
    again = fleet.start(REPLAY, 1, 0)
    until(lambda: again.pid)
    assert len(stage.hosts[3].starts) == 1
    assert len(stage.hosts) == 4
    until(lambda: stage.hosts[1].news)
    replay = stage.hosts[1].news[-1].addresses.replay
    assert replay.startswith("tcp://10.0.0.4:"), "the others hear of the place in which it lives"


def test_a_place_in_advance_that_is_lost_as_well_is_replaced(fleet: Fleet, stage: Stage) -> None:
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER)]
    until(lambda: all(each.pid for each in first))

    def lose(host: Host) -> None:
        host.is_lost = len(stage.hosts) == 2

    stage.prepare = lose
    stage.hosts[0].is_lost = True
    until(first[0].poll)
    again = fleet.start(REPLAY, 1, 0)
    until(lambda: again.pid)
    assert len(stage.hosts[-1].starts) == 1


def test_a_silent_host_counts_as_lost_after_the_lease_and_not_before(fleet: Fleet, stage: Stage) -> None:
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER)]
    until(lambda: all(each.pid for each in first))
    stage.hosts[0].is_silent = True
    begun_s = time.monotonic()
    until(first[0].poll)
    assert time.monotonic() - begun_s > CONFIG.cluster.lease_s - 0.5
    ended = first[0].poll()
    assert ended is not None
    assert ended.is_lost
    assert "not heard for 2 s" in ended.detail
    assert first[1].poll() is None


def test_a_host_where_nothing_can_run_ends_the_run_with_its_reason(fleet: Fleet, stage: Stage) -> None:
    def foreign(host: Host) -> None:
        host.problem = "not the launcher's run folder"

    stage.prepare = foreign
    placed = fleet.start(REPLAY, 0, 0)
    until(placed.poll)
    ended = placed.poll()
    assert ended is not None
    assert ended.code == USELESS
    assert "replay on host1: not the launcher's run folder" in ended.detail


def test_an_answer_that_makes_no_sense_to_the_thread_ends_the_run(fleet: Fleet, stage: Stage) -> None:
    def broken(host: Host) -> None:
        host.answer = lambda *_: 1 / 0  # type: ignore[method-assign]

    stage.prepare = broken
    placed = fleet.start(REPLAY, 0, 0)
    until(placed.poll)
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        fleet.start(REPLAY, 1, 0)


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


def test_news_that_a_look_could_not_carry_goes_again(fleet: Fleet, stage: Stage) -> None:
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER, ACTOR)]
    until(lambda: all(each.pid for each in first))
    replay, _, actor = stage.hosts
    replay.ended = True
    until(first[0].poll)
    actor.answer = _lost_news(actor)  # type: ignore[method-assign,assignment]
    fleet.start(REPLAY, 1, 0)
    until(lambda: actor.news)
    assert actor.news[-1].addresses.replay == "tcp://10.0.0.1:5101"


def _lost_news(host: Host) -> Callable[[str, tuple[object, ...]], object]:
    """Returns answers of a host that the first news does not reach."""
    lost: list[object] = []
    original = host.answer

    def answer(method: str, given: tuple[object, ...]) -> object:
        if method == "look" and given[1] is not None and not lost:
            lost.append(given)
            return OSError("its host does not answer")
        return original(method, given)

    return answer


@pytest.mark.parametrize("method", ["site", "start"])
def test_a_keeper_that_cannot_start_its_role_three_times_is_dismissed(method: str, fleet: Fleet, stage: Stage) -> None:
    def full(host: Host) -> None:
        if host.number == 1:
            host.failing, host.error = method, OSError(errno.ENOMEM, "Cannot allocate memory")

    stage.prepare = full
    for attempt in range(MOST_FAILED_STARTS):
        placed, learner = fleet.start(REPLAY, attempt, 0), fleet.start(LEARNER, attempt, 0)
        until(placed.poll)
        ended = placed.poll()
        assert ended is not None
        assert ended.code is None, "it may pass by itself"
        assert "Cannot allocate memory" in ended.detail
        assert learner.poll() is None
    until(lambda: stage.hosts[0].is_dismissed)  # a moment after the role is told
    again = fleet.start(REPLAY, MOST_FAILED_STARTS, 0)
    until(lambda: again.pid)
    assert len([host for host in stage.hosts if host.role is REPLAY]) == 2


def test_an_error_that_stays_counts_as_a_failure_of_the_role() -> None:
    for error, code in (
        (OSError(errno.EACCES, "Permission denied"), 1), (OSError("no answer"), None), (RuntimeError("no"), 1),
    ):  # fmt: skip
        placed = Placed(ACTOR, 1, "1 CPU", CONFIG, Hearing(20.0), lambda _: None)
        placed.take_error(error)
        ended = placed.poll()
        assert ended is not None
        assert ended.code == code


def test_a_place_of_a_further_actor_that_cannot_be_used_stays_empty(fleet: Fleet, stage: Stage) -> None:
    placed = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER, ACTOR)]
    until(lambda: all(each.pid for each in placed))

    def foreign(host: Host) -> None:
        host.problem = "not the launcher's run folder"

    stage.prepare = foreign
    late = fleet.start(Role("actor", 1), 0, 0)
    until(lambda: "not started on host4: not the launcher's run folder" in late.waiting)
    until(lambda: not fleet.is_waiting)
    until(lambda: stage.hosts[3]._looks > 1)
    assert late.poll() is None
    assert not stage.hosts[3].starts
    assert not stage.hosts[3].is_dismissed, "or Ray would find the same place again"


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


@pytest.mark.parametrize("pids_differ", [True, False])
def test_what_a_former_life_was_writing_is_removed_before_the_next_begins_unless_a_pid_is_shared(
    pids_differ: bool, fleet: Fleet, stage: Stage, tmp_path: Path
) -> None:
    def containers(host: Host) -> None:
        host.pids_differ = pids_differ

    stage.prepare = containers
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER)]
    until(lambda: all(each.pid for each in first))
    left = tmp_path / "checkpoints" / f".step-1.npz.{first[1].pid}.part"
    left.parent.mkdir()
    left.touch()
    stage.hosts[1].ended = True
    until(first[1].poll)
    fleet.start(LEARNER, 1, 0)
    assert left.exists() != pids_differ


def test_addresses_are_written_for_those_with_keys_and_follow_the_servers(stage: Stage, tmp_path: Path) -> None:
    for keys in ("/some/keys", ""):
        run = tmp_path / ("with" if keys else "without")
        run.mkdir()
        config = msgspec.structs.replace(CONFIG, transport=msgspec.structs.replace(CONFIG.transport, keys=keys))
        collector = ReportCollector("tcp://127.0.0.1:0", keys=new_keys())
        with Fleet(config, run, collector, new_keys(), stage) as fleet:
            placed = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER)]
            until(lambda placed=placed: all(each.pid for each in placed))  # type: ignore[misc]
            host = next(host for host in reversed(stage.hosts) if host.role is REPLAY)
            if keys:
                until((run / ADDRESSES).exists)
                assert (run / ADDRESSES).stat().st_mode & 0o777 == 0o600
                before = read_addresses(run / ADDRESSES)
                host.ended = True
                until(placed[0].poll)
                fleet.start(REPLAY, 1, 0)
                until(lambda before=before, run=run: read_addresses(run / ADDRESSES).replay != before.replay)  # type: ignore[misc]
                assert before.replay == "tcp://10.0.0.1:5100"
                assert read_addresses(run / ADDRESSES).replay == "tcp://10.0.0.1:5101"
        assert (run / ADDRESSES).exists() == bool(keys)
        collector.close()


def test_a_keeper_that_was_lost_between_two_lives_is_replaced_after_the_grace(fleet: Fleet, stage: Stage) -> None:
    first = [fleet.start(role, 0, 0) for role in (REPLAY, LEARNER)]
    until(lambda: all(each.pid for each in first))
    stage.hosts[0].ended = True
    until(first[0].poll)
    stage.hosts[0].is_lost = True
    until(lambda: fleet._kept["replay"].is_lost)
    lost_s = time.monotonic()
    fleet.start(REPLAY, 1, 0)
    until(lambda: len(stage.hosts) == 3)
    assert time.monotonic() - lost_s > ORPHANED_S
