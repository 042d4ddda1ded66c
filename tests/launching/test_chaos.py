"""A short form of the chaos run, whole; and the committed long one, which the documentation quotes."""

import json
import os
import random
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from apex_bat.config import Config
from apex_bat.config.loading import dumps
from benchmarks import chaos, chaos_report
from benchmarks.chaos_report import Course, Fault, Timeline
from tests.launching.small_run import SMALL, options

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "docs" / "results" / "chaos.json"
SETTINGS = {
    **SMALL, "actors": "2", "replay.snapshot_period_s": "2.0", "launch.max_failures": "100",
    "launch.heartbeat_timeout_s": "10.0",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_a_short_run_under_chaos_ends_as_asked_loses_nothing_unaccounted_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "chaos.json"
    arguments = ["--config", "", "--minutes", "1.0", "--period", "4", "--keep", str(tmp_path), "--json", str(path)]
    code = chaos.main(arguments + options(SETTINGS))
    result = json.loads(path.read_text())
    assert code == 0, {name: result[name] for name in ("checks", "leftovers", "resources", "faults")}
    assert len(result["faults"]) >= 2


def test_a_schedule_holds_every_kind_of_fault_once_a_round_and_follows_from_its_seed() -> None:
    rounds = list(islice(chaos.schedule(random.Random(1)), 3 * len(chaos.KINDS)))  # noqa: S311
    assert rounds == list(islice(chaos.schedule(random.Random(1)), len(rounds)))  # noqa: S311
    assert sorted(rounds[: len(chaos.KINDS)]) == sorted(chaos.KINDS)
    roles = ["replay", "learner", "actor-0", "actor-1", "evaluator"]
    for kind in chaos.KINDS:
        names = chaos.victims(kind, roles, random.Random(2))  # noqa: S311
        assert set(names) <= set(roles)
        assert len(set(names)) == (2 if kind == "kill two" else 1)


@pytest.mark.parametrize(
    ("changes", "adds_up"), [({}, True), ({"replay.evicted": 2.0}, False), ({"replay.refused": 1.0}, False)]
)
def test_an_account_with_a_transition_too_few_does_not_add_up(changes: dict[str, float], adds_up: bool) -> None:
    row = {"replay.inserted": 10.0, "replay.size": 7.0, "replay.evicted": 3.0, "replay.received": 12.0,
           "replay.refused": 2.0}  # fmt: skip
    assert chaos_report._adds_up(row | changes) == adds_up


def timeline(seconds: int) -> Timeline:
    """A run whose learner was replaced by no one."""
    made = Timeline()
    for second in range(seconds):
        row = {"role": "learner", "pid": 7, "state": "learning", "restarts": 0, "metrics": {"updates": 1.0}}
        made.take({"written_unix_s": float(second), "roles": [row]}, float(second))
    return made


def judged(folder: Path, course: Course) -> dict[str, Any]:
    """What is said of a run of a minute that failed before it wrote anything but its settings."""
    (folder / "config.toml").write_text(dumps(Config()))
    return chaos_report.report(folder, timeline(60), course, 1)


@pytest.mark.parametrize(("at_s", "period_s", "is_excused"), [(30.0, 4.0, False), (30.0, 10.0, True)])
def test_a_fault_without_recovery_is_excused_only_shortly_before_the_end(
    at_s: float, period_s: float, is_excused: bool, tmp_path: Path
) -> None:
    fault = Fault("kill learner", ("learner",), (7,), at_s, None)
    checks = judged(tmp_path, Course([fault], period_s, ""))["checks"]
    assert checks["every fault was recovered from"] == is_excused


@pytest.mark.parametrize("stuck", ["", "not all roles worked again after 80 s"])
def test_roles_that_do_not_work_again_are_a_failed_check(stuck: str, tmp_path: Path) -> None:
    result = judged(tmp_path, Course([], 10.0, stuck))
    assert result["checks"]["every role worked again before the next fault"] == (not stuck)


class Stuck:
    """A run whose roles work at first, and not after the first look."""

    def __init__(self, is_over: bool) -> None:
        self.flows, self.is_over = iter([True, False]), is_over
        self.process = self

    def wait_for_flow(self, _within_s: float) -> bool:
        self.has_flown = next(self.flows)
        return self.has_flown

    def look_until(self, _ends_s: float) -> None: ...

    def poll(self) -> int | None:
        return 0 if self.is_over and not self.has_flown else None


@pytest.mark.parametrize("is_over", [True, False])
def test_faults_end_with_a_reason_when_the_roles_of_a_living_run_do_not_work_again(is_over: bool) -> None:
    course = chaos.disturb(Stuck(is_over), chaos.Options(None, (), 10.0, 10.0, 0))  # type: ignore[arg-type]
    assert bool(course.stuck) is not is_over


def test_a_run_that_failed_at_once_has_a_table_too(tmp_path: Path) -> None:
    result = judged(tmp_path, Course([], 10.0, ""))
    result |= {"minutes": 1.0, "seed": 0, "launcher_killed": {"roles_ended_after_s": 1.0}}
    assert "- steps, - updates" in chaos_report.document(result)


def test_what_a_killed_launcher_could_not_remove_is_no_leftover_and_the_rest_is(tmp_path: Path) -> None:
    for name in ("replay", "sockets"):
        (tmp_path / name).mkdir()
    for name in (".status.json.11.part", "sockets/.x.part", "replay/replay.snapshot.writing"):
        (tmp_path / name).touch()
    assert chaos_report.leftovers_of(tmp_path, 11) == ["replay/replay.snapshot.writing"]
    assert len(chaos_report.leftovers_of(tmp_path)) == 3


@pytest.mark.skipif(not RESULT.exists(), reason="the long form has not been run")
def test_the_table_in_the_documentation_is_that_of_the_committed_result() -> None:
    result = json.loads(RESULT.read_text(encoding="utf-8"))
    assert chaos_report.document(result) in (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    assert all(result["checks"].values())
