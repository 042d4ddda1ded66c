"""apex_bat's own training, from the point of view of the contest: its command, and its rows from its run folder.

It runs as `apex-bat train --config configs/memory.toml` does, with its evaluator, recordings and snapshots, all of
which cost it time; only checkpoints are written more often and kept, for they are what is judged, and there is no
evaluation after the end.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from apex_bat.roles import checkpoint
from benchmarks.peers.notebook import Row
from benchmarks.peers.terms import CONFIG_FILE, Entry

RUN = "run"
"""The run folder within the training's folder."""
KEEP = 100_000
MUCH_LONGER = 10.0
"""Times the budget: the contest ends the training, by the clock that all have."""


def command(entry: Entry, seed: int, folder: Path, budget_s: float, every_s: float) -> list[str]:
    """Returns the command of a training."""
    settings = (
        f"seed={seed}", f"train.max_minutes={MUCH_LONGER * budget_s / 60.0:g}", f"checkpoint.period_s={every_s:g}",
        f"checkpoint.keep={KEEP}", "evaluation.arenas=[]", *entry.settings,
    )  # fmt: skip
    arguments = [sys.executable, "-m", "apex_bat", "train", "--config", str(CONFIG_FILE), "--plain", *entry.mode]
    for setting in settings:
        arguments += ["--set", setting]
    return [*arguments, "--run", str(folder / RUN)]


def rows(folder: Path, begin_unix_s: float) -> list[Row]:
    """Returns a row for the first flight and for each checkpoint, whose steps are those of the metrics of that moment.

    Args:
        folder: of the training.
        begin_unix_s: when the command was started, Unix time.
    """
    run = folder / RUN
    files = {path: path.stat().st_mtime for path in checkpoint.find(run / "checkpoints")}
    metrics = _metrics(run / "metrics" / "learner.jsonl")
    if not files or not metrics:
        return []
    unix_s = [row["unix_s"] for row in metrics]
    steps = [row["env_steps_total"] for row in metrics]
    flying_s = next((row["unix_s"] - row["elapsed_s"] for row in metrics if row["env_steps_total"]), unix_s[0])
    first = Row(round(flying_s - begin_unix_s, 3), 0, 0)
    return [first] + [
        Row(
            round(written_s - begin_unix_s, 3), int(np.interp(written_s, unix_s, steps)), checkpoint.step_of(path),
            str(path.relative_to(folder)),
        )
        for path, written_s in sorted(files.items(), key=lambda item: item[1])
    ]  # fmt: skip


def _metrics(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
