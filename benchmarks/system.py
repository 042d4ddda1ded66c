"""Whole runs of a minute with 1, 2 and 4 actor processes: steps, updates and samples per insert.

Run it with `apex-bat bench system` or `python -m benchmarks.system`. On two cores the roles share them: the figures say
what such a machine gives, not how the system scales.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.replay import Record, summary

MINUTES = 0.75
SETTLED_S = 20.0  # rows before this are left out: the replay fills, the learner has not begun
NUM_ACTORS = (1, 2, 4)
BEGINS = 3


def measure() -> list[Record]:
    """Returns the records that `apex-bat bench system` writes; a run is the rows of its reports, a second each."""
    begins = [_seconds_to_begin() for _ in range(BEGINS)]
    flown_s, learnt_s = ([begin[i] for begin in begins] for i in range(2))
    records = [summary("system.first_step_s", "s", flown_s), summary("system.first_update_s", "s", learnt_s)]
    return records + [record for num_actors in NUM_ACTORS for record in _measure(num_actors)]


def _seconds_to_begin() -> tuple[float, float]:
    """Returns the times from the command to first environment step and first update of a run with the defaults."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        begun_s = time.perf_counter()
        with subprocess.Popen(
            [sys.executable, "-m", "apex_bat", "train", "--plain", "--run", str(run)], stdout=subprocess.DEVNULL
        ) as launcher:
            try:
                marks = (("actor-*.log", "begins to fly"), ("learner.log", "begins to learn"))
                flown_s, learnt_s = (_wait_for(run / "logs", logs, line, launcher) for logs, line in marks)
                return flown_s - begun_s, learnt_s - begun_s
            finally:
                launcher.terminate()


def _wait_for(folder: Path, logs: str, line: str, launcher: subprocess.Popen[bytes]) -> float:
    """Returns when a line stands in one of the logs, by `time.perf_counter`."""
    while not any(line in log.read_text(encoding="utf-8") for log in folder.glob(logs)):
        if launcher.poll() is not None:
            raise RuntimeError(f"the run ended with exit code {launcher.returncode} before a role {line}")
        time.sleep(0.05)
    return time.perf_counter()


def _measure(num_actors: int) -> list[Record]:
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [
            sys.executable, "-m", "apex_bat", "train", "--plain", "--run", str(run),
            "--set", f"actors={num_actors}", "--set", f"train.max_minutes={MINUTES}",
            "--set", "evaluation.during_training=false", "--set", "evaluation.arenas=[]",
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ)
        rows = {path.stem: read_rows(path, SETTLED_S) for path in (run / "metrics").glob("*.jsonl")}
    name = f"system.actors_{num_actors}"
    steps = [
        sum(rates)
        for rates in zip(*(_series(rows[f"actor-{i}"], "env_steps_per_s") for i in range(num_actors)), strict=False)
    ]
    replay = rows["replay"]
    return [
        summary(f"{name}.steps_per_s", "1/s", steps),
        summary(f"{name}.updates_per_s", "1/s", _series(rows["learner"], "updates_per_s")),
        summary(f"{name}.samples_per_insert", "1", _series(replay, "replay.samples_per_insert")),
        summary(f"{name}.policy_lag", "updates", _series(replay, "replay.policy_lag")),
        summary(f"{name}.learner_idle_share", "1", _series(rows["learner"], "share.waiting")),
    ]


def read_rows(path: Path, settled_s: float) -> list[dict[str, Any]]:
    """Returns a file's rows from when the run had flown for some time."""
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [row for row in rows if row["elapsed_s"] >= settled_s]


def _series(rows: list[dict[str, Any]], name: str) -> list[float]:
    return [float(row[name]) for row in rows if name in row]


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
