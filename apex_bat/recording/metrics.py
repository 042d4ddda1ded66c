"""The metrics of a run: rows appended to one file a role, and TensorBoard events.

Each row is a JSON object on a line of its own, written and flushed at once, so that a crash loses nothing. What each
figure is stands in `apex_bat.roles.metrics`.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TextIO

from tensorboardX import SummaryWriter

from apex_bat.storage import StorageError
from apex_bat.transport.messages import Report


class MetricsWriter:
    """Appends the rows of all roles of a run."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, TextIO] = {}
        self._events = SummaryWriter(str(folder / "tensorboard"), flush_secs=10)

    def append(self, report: Report, elapsed_s: float, env_steps: float, learner_step: float) -> None:
        """Appends the report of a role with the counters of the whole run.

        Args:
            report: what the role said.
            elapsed_s: time since the first environment step of the run.
            env_steps: environment steps of all bats.
            learner_step: updates of the learner.

        Raises:
            StorageError: the disk is full.
        """
        if report.role not in self._files:
            self._files[report.role] = (self._folder / f"{report.role}.jsonl").open("a", encoding="utf-8")
        row = {
            "unix_s": round(time.time(), 3), "elapsed_s": round(elapsed_s, 3), "role": report.role, "pid": report.pid,
            "env_steps_total": env_steps, "learner_step_total": learner_step, "state": report.state, **report.metrics,
        }  # fmt: skip
        file = self._files[report.role]
        try:
            file.write(json.dumps(row) + "\n")
            file.flush()
        except OSError as error:
            raise StorageError(f"{file.name}: cannot be written: {error.strerror or error}") from None
        for name, value in report.metrics.items():
            self._events.add_scalar(f"{report.role}/{name}", value, int(env_steps))

    def close(self) -> None:
        """Closes all files."""
        for file in self._files.values():
            file.close()
        self._events.close()
