"""The metrics of a run: rows appended to one file a role, TensorBoard events, and the recording of the training.

Each row is a JSON object on a line of its own, written at once, whole or not at all, so that neither a crash nor a full
disk tears one. Where a power cut did, the next row begins on a new line. What each figure is stands in
`apex_bat.roles.metrics`.
"""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Callable
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING

from apex_bat.recording.event_file import EventFile
from apex_bat.recording.tensorboard import Event, EventsWriter, Summary
from apex_bat.storage import StorageError
from apex_bat.transport.messages import Report

if TYPE_CHECKING:
    from apex_bat.recording.training import TrainingRecording


class MetricsWriter:
    """Appends the rows of all roles of a run."""

    def __init__(
        self,
        folder: Path,
        training: TrainingRecording | None = None,
        clock: Callable[[], float] = time.time,
        open_events: Callable[[str, str], EventsWriter | EventFile] = EventsWriter,
    ) -> None:
        """Opens nothing yet.

        Args:
            folder: of the files.
            training: what else gets every row.
            clock: the time that rows and events carry, in seconds.
            open_events: opens a TensorBoard file from the beginning of its path and the end of its name.
        """
        self._folder, self._training, self._clock, self._open_events = folder, training, clock, open_events
        self._files: dict[str, FileIO] = {}
        self._events: EventsWriter | EventFile | None = None
        self._num_event_files = 0

    def append(
        self, report: Report, elapsed_s: float, env_steps: float, learner_step: float, unix_s: float | None = None
    ) -> None:
        """Appends the report of a role with the counters of the whole run.

        Args:
            report: what the role said.
            elapsed_s: time since the first environment step of the run.
            env_steps: environment steps of all bats.
            learner_step: updates of the learner.
            unix_s: when the report came, by the writer's clock; None: now.

        Raises:
            StorageError: the disk is full.
        """
        unix_s = self._clock() if unix_s is None else unix_s
        row = {
            "unix_s": round(unix_s, 3), "elapsed_s": round(elapsed_s, 3), "role": report.role, "pid": report.pid,
            "env_steps_total": env_steps, "learner_step_total": learner_step, "state": report.state, **report.metrics,
        }  # fmt: skip
        if self._training is not None:
            self._training.take(row)
        path = self._folder / f"{report.role}.jsonl"
        try:
            if report.role not in self._files:
                self._files[report.role] = path.open("a+b", buffering=0)
            _append_line(self._files[report.role], json.dumps(row))
            self._append_events(report, env_steps, unix_s)
        except OSError as error:
            raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None

    def _append_events(self, report: Report, env_steps: float, unix_s: float) -> None:
        values = [Summary.Value(tag=f"{report.role}/{name}", simple_value=v) for name, v in report.metrics.items()]
        try:
            if self._events is None:
                # Not SummaryWriter: its thread dies on a full disk, and its queue of ten then blocks us for ever.
                (self._folder / "tensorboard").mkdir(exist_ok=True)
                self._num_event_files += 1
                suffix = "" if self._num_event_files == 1 else f".{self._num_event_files}"
                self._events = self._open_events(str(self._folder / "tensorboard" / "events"), suffix)
            self._events.write_event(Event(wall_time=unix_s, step=int(env_steps), summary=Summary(value=values)))
            self._events.flush()
        except OSError:  # its end may be torn, and what follows a torn event is not read: the next goes to a new file
            self._events = None
            raise

    def close(self) -> None:
        """Closes all files."""
        for file in self._files.values():
            with suppress(OSError):  # what could not be written was said when it was tried
                file.close()
        if self._events is not None:
            with suppress(OSError):
                self._events.close()
        if self._training is not None:
            self._training.close()


def _append_line(file: FileIO, text: str) -> None:
    """Appends a line in one piece; what a full disk took of it is cut off again. Raises OSError."""
    begin = file.seek(0, os.SEEK_END)
    data = (b"\n" if _is_torn(file, begin) else b"") + text.encode() + b"\n"
    if file.write(data) == len(data):
        return
    file.truncate(begin)
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _is_torn(file: FileIO, length: int) -> bool:
    """Whether the last line of a file of some length has no end, and what is appended would be lost with it."""
    if length == 0:
        return False
    file.seek(length - 1)
    return file.read(1) != b"\n"
