"""The metrics of a run: rows appended to one file a role, TensorBoard events, and the recording of the training.

Each row is a JSON object on a line of its own, written and flushed at once, so that a crash loses nothing. What each
figure is stands in `apex_bat.roles.metrics`.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.proto.summary_pb2 import Summary

from apex_bat.storage import StorageError
from apex_bat.transport.messages import Report

if TYPE_CHECKING:
    from apex_bat.recording.training import TrainingRecording


class MetricsWriter:
    """Appends the rows of all roles of a run."""

    def __init__(self, folder: Path, training: TrainingRecording | None = None) -> None:
        """Takes the folder of the files, and what else gets every row."""
        self._folder, self._training = folder, training
        self._files: dict[str, TextIO] = {}
        (folder / "tensorboard").mkdir(exist_ok=True)
        # Not SummaryWriter: its thread dies on a full disk, and then its queue of ten blocks the launcher for ever.
        self._events = EventsWriter(str(folder / "tensorboard" / "events"))

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
            self._append_events(report, env_steps)
        except OSError as error:
            raise StorageError(f"{file.name}: cannot be written: {error.strerror or error}") from None
        if self._training is not None:
            self._training.take(row)

    def _append_events(self, report: Report, env_steps: float) -> None:
        values = [Summary.Value(tag=f"{report.role}/{name}", simple_value=v) for name, v in report.metrics.items()]
        self._events.write_event(Event(wall_time=time.time(), step=int(env_steps), summary=Summary(value=values)))
        self._events.flush()

    def close(self) -> None:
        """Closes all files."""
        for file in self._files.values():
            with suppress(OSError):  # what could not be written was said when it was tried
                file.close()
        with suppress(OSError):
            self._events.close()
        if self._training is not None:
            self._training.close()
