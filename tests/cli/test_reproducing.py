"""`reproduce` and `evaluate --policy`: what is refused, and a whole small campaign, killed and continued."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
from rich.console import Console

from apex_bat.cli import reproducing
from apex_bat.config import load
from apex_bat.evaluation import runs
from apex_bat.evaluation.reproduction import Planned, plan
from apex_bat.launching import course, local
from apex_bat.launching.lock import InUseError, locked
from apex_bat.storage import StorageError
from tests.cli.conftest import Command, Refused

SMALL = (
    "actors=1", "bats_per_actor=4", "sonar.rendering=exact", "replay.min_size=200", "replay.capacity=5_000",
    "replay.samples_per_insert=2.0", "learner.batch_size=16", "learner.weights_period=5", "network.channels=[4]",
    "network.strides=[3]", "network.hidden=[16]", "actor.chunk_transitions=10", "evaluation.flights=2",
    "evaluation.period_s=1.0", "checkpoint.period_s=1.0", "recording.evaluation_flights=0",
    "recording.sampled_flights=0", "recording.every_episodes=0", "episode.evaluation_steps=20",
)  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["reproduce", "--conditions", "memory,sight"], 2, "sight: no such condition; there are memory, "),
        (["reproduce", "--set", "replay.never_block=true"], 2, "samples per insert"),
        (["reproduce", "--arenas", "labyrinth"], 2, "no such arena"),
        (["reproduce", "--arenas", "corridor:0-3"], 2, "one arena at a time"),
        (["reproduce", "--arenas", "simple,simple"], 2, "each once"),
        (["reproduce", "--set", "train.max_updates=5"], 2, "--budget alone"),
        (["reproduce", "--seeds", "0"], 2, "--seeds"),
        (["reproduce", "nowhere"], 2, "--from"),
        (["reproduce", "--from"], 2, "--from"),
        (["reproduce", "--from", "nowhere"], 1, "no run here"),
        (["reproduce", "--from", "nowhere", "--set", "seed=3"], 2, "change trainings"),
        (["evaluate"], 2, "--policy"),
        (["evaluate", "nowhere", "--policy", "ild"], 2, "one of them"),
        (["evaluate", "--policy", "best"], 2, "random, straight, ild, oracle"),
        (["evaluate", "--policy", "ild", "--record", "1"], 2, "--record"),
        (["evaluate", "--policy", "ild", "--set", "episode.nonsense=1"], 2, "no such setting"),
    ],
)
def test_wrong_usage_starts_nothing(arguments: list[str], code: int, says: str, refused: Refused) -> None:
    refused(arguments, code, says)


@pytest.fixture
def planned(tmp_path: Path) -> Planned:
    return plan(tmp_path, load(None, []), ("memory",), 1, 100)[0]


def train(planned: Planned) -> bool:
    return reproducing._train(planned, "run 1 of 1", Console(file=io.StringIO()), plain=True)


def test_what_another_process_trained_meanwhile_is_not_trained_again(
    planned: Planned, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs.create(planned.folder, planned.config)
    runs.finish(planned.folder, "completed", env_steps=100)
    before = (planned.folder / "run.json").read_text()
    monkeypatch.setattr(local, "train", None)  # a call of it would raise
    assert train(planned)
    assert (planned.folder / "run.json").read_text() == before


@pytest.mark.parametrize(("outcome", "goes_on"), [("completed", True), ("interrupted", False)])
def test_how_a_training_ended_is_noted_while_its_folder_is_locked(
    outcome: course.Outcome, goes_on: bool, planned: Planned, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[bool] = []

    def finish(folder: Path, *_: object, **__: object) -> None:
        with pytest.raises(InUseError), locked(folder):
            pass
        held.append(True)
        raise StorageError("the disk is full")  # which is no reason to fail a training that is over

    monkeypatch.setattr(local, "train", lambda *_, **__: course.Ended(outcome, "", 100, 10, 1.0))
    monkeypatch.setattr(runs, "finish", finish)
    assert train(planned) is goes_on
    assert held == [True]


def test_a_training_that_fails_ends_the_campaign(planned: Planned, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "train", lambda *_, **__: course.Ended("failed", "actor-0 died", 100, 10, 1.0))
    with pytest.raises(typer.Exit):
        train(planned)
    assert json.loads((planned.folder / "run.json").read_text())["outcome"] == "failed"


def test_a_baseline_is_evaluated_without_a_run(command: Command, tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    arguments = ["evaluate", "--policy", "straight", "--arenas", "simple, circle", "--flights", "2", "--json",
                 str(path), "--set", "episode.evaluation_steps=30"]  # fmt: skip
    assert command(arguments)[0] == 0
    result = json.loads(path.read_text())
    assert [row["arena"] for row in result["summary"]] == ["simple", "circle"]
    assert result["run"] == "straight"
    assert all(flight["action_shares"] == [1.0, 0.0, 0.0] for flight in result["flights"])


def campaign(folder: Path) -> subprocess.Popen[str]:
    """Starts a small campaign of two trainings."""
    overrides = [argument for change in SMALL for argument in ("--set", change)]
    command = [sys.executable, "-m", "apex_bat", "reproduce", "--seeds", "1", "--conditions", "memory,onset", "--plain",
               "--budget", "1500", "--arenas", "simple", "--folder", str(folder), *overrides]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.mark.slow
def test_a_killed_campaign_goes_on_and_ends_in_a_report(tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    first = campaign(folder)
    try:
        deadline_s = time.monotonic() + 120.0
        while not (folder / "onset-0" / "status.json").exists():
            assert first.poll() is None, first.communicate()[0]
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
    finally:
        os.kill(first.pid, signal.SIGKILL)
        first.communicate()
    begun = json.loads((folder / "memory-0" / "run.json").read_text())["start"]
    again = campaign(folder)
    output, _ = again.communicate(timeout=300.0)
    assert again.returncode == 0, output
    assert "run 1 of 2: memory, seed 0: is there" in output
    assert "run 2 of 2: onset, seed 0: was cut off and begins anew" in output
    assert json.loads((folder / "memory-0" / "run.json").read_text())["start"] == begun, "not trained again"
    facts = json.loads((folder / "onset-0" / "run.json").read_text())
    assert facts["outcome"] == "completed"
    assert facts["env_steps"] >= 1500
    text = (folder / "report" / "report.md").read_text()
    assert re.search(r"Seeds: memory \(\d+ other settings, \w+\) 1, onset \(\d+ other settings, \w+\) 1\.", text)
    assert "other flights than the thesis's" in text
    assert (folder / "report" / "index.html").stat().st_size > 100_000
    evaluate_under_other_settings(folder / "memory-0", tmp_path / "out.json")


def evaluate_under_other_settings(run: Path, path: Path) -> None:
    """Checks that a policy flies by another rendering than it was trained with, and not with another network."""
    command = [sys.executable, "-m", "apex_bat", "evaluate", str(run), "--arenas", "simple", "--json", str(path)]
    subprocess.run([*command, "--set", "sonar.rendering=thesis"], check=True, capture_output=True)
    result = json.loads(path.read_text())
    assert result["rendering"] == "thesis"
    assert result["changed"] == ["sonar.rendering: exact | thesis"]
    refused = subprocess.run([*command, "--set", "sensing.memory_steps=5"], capture_output=True, text=True)
    assert refused.returncode == 1
    assert "the weights are of another network" in refused.stderr
