"""Whole runs that are stopped, in every way, and resumed by the command."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from apex_bat.launching import serial_state
from apex_bat.launching.lock import InUseError, locked
from apex_bat.replay.verification import verify
from apex_bat.roles import checkpoint
from apex_bat.storage import digest

SMALL = (
    "bats_per_actor=3", "replay.samples_per_insert=2.0", "learner.batch_size=16", "learner.weights_period=5",
    "network.channels=[4]", "network.strides=[3]", "network.hidden=[16]", "actor.chunk_transitions=10",
    "evaluation.flights=2", "evaluation.period_s=1.0", "checkpoint.period_s=0.6", "recording.evaluation_flights=1",
    "recording.curves=false", "episode.evaluation_steps=12", "rays.num_azimuth=12", "rays.num_elevation=2",
    "sonar.rendering=exact", "train.max_minutes=none",
)  # fmt: skip
ASYNCHRONOUS = (*SMALL, "actors=1", "replay.min_size=200", "replay.capacity=5000", "train.max_updates=100000")
SERIAL = (*SMALL, "actors=2", "replay.min_size=60", "replay.capacity=300", "replay.snapshot_period_s=0.5")

pytestmark = pytest.mark.slow


def train(*arguments: str, settings: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    overrides = [argument for setting in settings for argument in ("--set", setting)]
    command = [sys.executable, "-m", "apex_bat", "train", "--plain", *arguments, *overrides]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, preexec_fn=_hear_ctrl_c
    )


def _hear_ctrl_c() -> None:
    """Makes SIGINT heard where the tests run in the background, which makes their children ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def finished(process: subprocess.Popen[str], code: int) -> str:
    output, _ = process.communicate(timeout=300)
    assert process.returncode == code, output
    assert "Traceback" not in output
    return output


def eventually(condition: Callable[[], object], what: str, within_s: float = 180.0) -> None:
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {within_s} s: {what}"
        time.sleep(0.05)


def rows(run: Path, role: str) -> list[dict[str, Any]]:
    path = run / "metrics" / f"{role}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def is_learning(run: Path) -> bool:
    """Whether it has learned, and a checkpoint was written."""
    learned = any(row.get("learner_step", 0) > 20 for row in rows(run, "learner")[-1:])
    return learned and bool(checkpoint.find(run / "checkpoints"))


@pytest.fixture
def started() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts trainings, and kills what the test leaves alive."""
    processes = []

    def start(*arguments: str, settings: tuple[str, ...] = ()) -> subprocess.Popen[str]:
        processes.append(train(*arguments, settings=settings))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_goes_on_with_everything_it_had(
    how: signal.Signals, started: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    process = started("--run", str(run), settings=ASYNCHRONOUS)
    eventually(lambda: is_learning(run), "the learner learns")
    second = finished(started("--resume", str(run)), 1)
    assert "is still running" in second
    process.send_signal(how)
    process.communicate(timeout=120)

    if how == signal.SIGKILL:  # its roles write their last files before they end
        eventually(lambda: not _is_locked(run), "the roles are gone")
    status = json.loads((run / "status.json").read_text())["progress"]
    newest = checkpoint.load_newest(run / "checkpoints")
    replay = verify(run / "replay" / "replay.snapshot")
    assert newest is not None
    assert replay is not None
    assert replay.transitions > 200
    lengths = {role: len(rows(run, role)) for role in ("actor-0", "learner", "replay")}

    limit = f"train.max_updates={newest.learner_step + 60}"
    output = finished(started("--resume", str(run), settings=(limit,)), 0)
    assert f"resumed: update {newest.learner_step:,}" in output
    facts = json.loads((run / "run.json").read_text())
    (resumed,) = facts["resumed"]
    network = {name: array for name, array in newest.arrays.items() if name.startswith("online/")}
    assert resumed["sha256"]["network"] == digest(network)
    assert resumed["sha256"]["replay"] == replay.sha256
    assert (resumed["updates"], resumed["transitions"]) == (newest.learner_step, replay.transitions)
    assert resumed["env_steps"] == int(status["env_steps"]) > 200
    assert facts["outcome"] == "completed"
    assert (run / "config.toml.1").exists()

    first = {role: rows(run, role)[lengths[role] :] for role in lengths}
    assert first["learner"][0]["learner_step"] >= newest.learner_step
    assert first["replay"][0]["replay.inserted"] >= replay.inserted, "the replay did not begin empty"
    assert first["actor-0"][0]["env_steps_total"] >= status["env_steps"], "and the counters go on"
    assert first["actor-0"][0]["elapsed_s"] >= round(status["elapsed_s"], 3), "as rows have it"
    assert newest.learner_step + 60 <= facts["learner_steps"] < newest.learner_step + 200


def _is_locked(run: Path) -> bool:
    try:
        with locked(run):
            return False
    except InUseError:
        return True


def test_a_serial_run_that_was_killed_ends_with_the_bytes_of_one_that_was_not(
    started: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    limit = ("train.max_env_steps=1500",)
    finished(started("--serial", "--run", str(whole), settings=(*SERIAL, *limit)), 0)
    process = started("--serial", "--run", str(broken), settings=(*SERIAL, "train.max_env_steps=1000000"))
    for how in (signal.SIGKILL, signal.SIGINT):
        last = serial_state.find(broken)[-1:]
        eventually(lambda last=last: serial_state.find(broken)[-1:] != last, "another state is saved")  # type: ignore[misc]
        process.send_signal(how)
        process.communicate(timeout=120)
        assert process.returncode == (130 if how == signal.SIGINT else -how)
        if how == signal.SIGKILL:
            process = started("--resume", str(broken))
    output = finished(started("--resume", str(broken), "--serial", settings=limit), 0)
    assert "resumed: update" in output
    for folder in ("metrics", "checkpoints"):
        names = sorted(path.relative_to(whole) for path in (whole / folder).rglob("*") if path.is_file())
        assert names == sorted(path.relative_to(broken) for path in (broken / folder).rglob("*") if path.is_file())
        for name in names:
            assert (whole / name).read_bytes() == (broken / name).read_bytes(), name
    assert len(json.loads((broken / "run.json").read_text())["resumed"]) == 2
