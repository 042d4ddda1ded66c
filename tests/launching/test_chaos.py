"""A short form of the chaos run, whole; and the committed long one, which the documentation quotes."""

import json
import os
import random
from itertools import islice
from pathlib import Path

import pytest

from benchmarks import chaos, chaos_report

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "docs" / "results" / "chaos.json"
SMALL = (
    "actors=2", "bats_per_actor=4", "replay.min_size=200", "replay.capacity=5_000", "replay.samples_per_insert=2.0",
    "learner.batch_size=16", "learner.weights_period=5", "network.channels=[4]", "network.strides=[3]",
    "network.hidden=[16]", "actor.chunk_transitions=10", "evaluation.flights=2", "evaluation.period_s=1.0",
    "checkpoint.period_s=1.0", "replay.snapshot_period_s=2.0", "recording.evaluation_flights=1",
    "episode.evaluation_steps=40", "launch.max_failures=100", "launch.heartbeat_timeout_s=10.0",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_a_short_run_under_chaos_ends_as_asked_loses_nothing_unaccounted_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "chaos.json"
    arguments = ["--config", "", "--minutes", "1.0", "--period", "4", "--keep", str(tmp_path), "--json", str(path)]
    for setting in SMALL:
        arguments += ["--set", setting]
    code = chaos.main(arguments)
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


@pytest.mark.skipif(not RESULT.exists(), reason="the long form has not been run")
def test_the_table_in_the_documentation_is_that_of_the_committed_result() -> None:
    result = json.loads(RESULT.read_text(encoding="utf-8"))
    assert chaos_report.document(result) in (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    assert all(result["checks"].values())
