"""What becomes of the reports of a serial run: rows of metrics without anything of the machine, status, and view."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from msgspec import structs

from apex_bat.config import Config
from apex_bat.launching.live import View
from apex_bat.launching.lost_writes import LostWrites
from apex_bat.launching.rows import RowThinner
from apex_bat.launching.standing import Origin, Standing
from apex_bat.launching.status_file import STATUS_PERIOD_S, StatusFile
from apex_bat.launching.supervisor import Exit, Watched
from apex_bat.recording.event_file import EventFile
from apex_bat.recording.metrics import MetricsWriter
from apex_bat.recording.training import TrainingRecording
from apex_bat.roles.plan import roles_of
from apex_bat.transport.messages import Report

VIEW_PERIOD_S = 0.25


class SerialReports:
    """The reports' line of all roles.

    Args:
        config: the settings.
        run: the run folder.
        clock: the run's own time, which rows carry.
        counters: returns environment steps and updates of the whole run.
        origin: what an earlier part of the run has used up.
    """

    def __init__(
        self,
        config: Config,
        run: Path,
        clock: Callable[[], float],
        counters: Callable[[], tuple[int, int]],
        origin: Origin,
    ) -> None:
        self._clock, self._counters = clock, counters
        self.thinner = RowThinner(config.launch.dense_rows_s)
        self._standing = Standing(config, time.monotonic(), origin)
        self._watched = {role.name: Watched(role) for role in roles_of(config)}
        for watched in self._watched.values():
            watched.handle = _ThisProcess()
        training = TrainingRecording(config, run) if config.recording.curves else None
        self._metrics = MetricsWriter(run / "metrics", training, clock, partial(EventFile, clock=clock))
        self._sent: dict[str, tuple[float, float]] = {}
        self._status, self._lost_writes = StatusFile(run), LostWrites()
        self._view_due_s = self._status_due_s = -math.inf

    @property
    def wall_elapsed_s(self) -> float:
        """Wall-clock time since the first step, with that of earlier parts of the run."""
        self._standing.now_s = time.monotonic()
        return self._standing.elapsed_s

    def is_out_of_time(self) -> bool:
        """Whether `train.max_minutes` are over."""
        limit = self._standing.config.train.max_minutes
        return limit is not None and self.wall_elapsed_s >= 60.0 * limit

    def send(self, report: Report) -> None:
        """Takes a report. A row that the disk does not take is left out."""
        finite = {name: value for name, value in report.metrics.items() if math.isfinite(value)}
        report = structs.replace(report, metrics=finite)
        self._standing.take(self._in_wall_time(report), time.monotonic())
        row = self.thinner.take(structs.replace(report, pid=0, host=""), self._clock())
        if row is not None:
            self._append(row)

    def show(self, view: View) -> None:
        """Shows the run, and writes its status, if the last time is long enough ago."""
        now_s = self._standing.now_s = time.monotonic()
        if now_s >= self._view_due_s:
            self._view_due_s = now_s + VIEW_PERIOD_S
            view.show(self._standing, self._watched)
        if now_s >= self._status_due_s:
            self._status_due_s = now_s + STATUS_PERIOD_S
            self._write_status(ended=False)

    def end(self) -> None:
        """Writes the last rows and the last status."""
        for row in self.thinner.rest():
            self._append(row)
        for watched in self._watched.values():
            watched.handle, watched.is_done = None, True
        self._write_status(ended=True)

    def close(self) -> None:
        """Closes all files; may be called for each role."""
        self._metrics.close()

    def _append(self, row: Report) -> None:
        # In the order of names: what was restored has another order than what was never saved.
        row = structs.replace(row, metrics=dict(sorted(row.metrics.items())))
        env_steps, learner_step = self._counters()
        with self._lost_writes.borne():
            self._metrics.append(row, self._clock(), float(env_steps), float(learner_step))

    def _in_wall_time(self, report: Report) -> Report:
        """Returns a report whose rates are those that a person watches."""
        now = self._clock(), time.monotonic()
        before = self._sent.get(report.role, now)
        self._sent[report.role] = now
        slower = (now[0] - before[0]) / max(now[1] - before[1], 1e-9)
        rates = {name: slower * value for name, value in report.metrics.items() if name.endswith("_per_s")}
        return structs.replace(report, metrics=report.metrics | rates)

    def _write_status(self, *, ended: bool) -> None:
        with self._lost_writes.borne():
            self._status.write(self._standing, self._watched, has_ended=ended)


class _ThisProcess:
    """What the view and the status know of a role that runs here."""

    pid = os.getpid()
    waiting = ""

    def poll(self) -> Exit | None:
        """Returns None: it runs."""

    def stop(self) -> None:
        """Does nothing."""

    def kill(self) -> None:
        """Does nothing."""
