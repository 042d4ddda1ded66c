"""Roles on hosts that a test plays: places, moves, losses, and nobody twice."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
import pytest

from apex_bat.config import Config, load
from apex_bat.launching.cluster import fleet as module
from apex_bat.launching.cluster.fleet import Fleet, LostError
from apex_bat.launching.cluster.keeper import Look, Site
from apex_bat.launching.cluster.lease import MARGIN_S, Hearing
from apex_bat.launching.cluster.placed import Placed
from apex_bat.launching.supervisor import USELESS
from apex_bat.roles.orders import Orders
from apex_bat.roles.plan import Role
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
            life, orders = given[0], given[-1]
            assert isinstance(life, int)
            self._life = life
            self.starts.append(_orders(orders))
            self.ended = False
            return 1000 + len(self.starts)
        if method == "look":
            self._looks += 1
            if given[1] is not None:
                self.news.append(_orders(given[1]))
            return Look(self._looks, self._life or -1, 1000 + len(self.starts), self.ended, 4, "it ended")
        return None


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
            elif host.has_place and not host.is_silent:
                yield ticket, host.answer(method, given)


@pytest.fixture
def stage() -> Stage:
    return Stage()


@pytest.fixture
def fleet(stage: Stage) -> Iterator[Fleet]:
    collector = ReportCollector("tcp://127.0.0.1:0", keys=new_keys())
    with Fleet(CONFIG, collector, new_keys(), stage) as one:
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


class Clock:
    """Shows what the test says."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def placed_on(role: Role, clock: Clock, config: Config = CONFIG) -> tuple[Placed, list[str]]:
    hearing, orders = Hearing(20.0), list[str]()
    placed = Placed(role, 1, "1 CPU", config, hearing, orders.append, clock)
    placed.take_site(Site("h", "10.0.0.1", 5000, ""))
    placed.begin()
    placed.take_start(7)
    hearing.take(0.0, 1)
    return placed, orders


def test_a_writer_whose_keeper_died_has_the_grace_to_write_its_last_files() -> None:
    for role, wait_s in ((LEARNER, CONFIG.launch.grace_s + MARGIN_S), (REPLAY, 1.0 + MARGIN_S), (ACTOR, 0.0)):
        clock = Clock()
        placed, _ = placed_on(role, clock)
        placed.take_loss("it died")
        clock.now_s = wait_s - 1e-3
        assert (placed.poll() is None) == (wait_s > 0.0)
        clock.now_s = wait_s
        ended = placed.poll()
        assert ended is not None
        assert ended.is_lost


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
    placed.take_loss("cannot import apex_bat")
    ended = placed.poll()
    assert ended is not None
    assert (ended.code, ended.is_lost) == (1, False)
