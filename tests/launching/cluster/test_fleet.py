"""Roles on hosts that a test plays: places, moves, losses, and nobody twice."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from apex_bat.launching.cluster.fleet import Fleet
from apex_bat.launching.cluster.kept import MOST_FAILED_STARTS
from apex_bat.launching.cluster.lease import Hearing
from apex_bat.launching.cluster.placed import Placed
from apex_bat.launching.supervisor import USELESS
from apex_bat.roles.orders import ORPHANED_S
from apex_bat.roles.plan import Role, read_addresses
from apex_bat.roles.process import ADDRESSES
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import new_keys
from tests.launching.cluster.stage import ACTOR, CONFIG, LEARNER, REPLAY, Host, Stage, until


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
