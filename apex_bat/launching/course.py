"""The course of one run, on whatever its roles run: watching them, taking their reports, ending them in order."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from apex_bat.config import Config
from apex_bat.launching.live import View
from apex_bat.launching.lost_writes import LostWrites
from apex_bat.launching.rows import RowThinner
from apex_bat.launching.standing import Origin, Standing
from apex_bat.launching.status_file import STATUS_PERIOD_S, StatusFile
from apex_bat.launching.supervisor import Handle, RoleFailedError, Supervisor
from apex_bat.roles.plan import Role, incarnation_of, roles_of
from apex_bat.transport.messages import Report
from apex_bat.transport.reports import ReportCollector

if TYPE_CHECKING:
    from apex_bat.recording.metrics import MetricsWriter

GROWTH_PERIOD_S = 1.0
MANY_ROWS = 1000
"""Rows of a run that does not get under way, after which these are written all the same."""
_log = logging.getLogger(__name__)

Start = Callable[[Role, int, int], Handle]
"""Starts a role: which, the number of this life of it, and the environment steps of the whole run so far."""
Outcome = Literal["completed", "interrupted", "failed"]


class Ended(NamedTuple):
    """How a run ended."""

    outcome: Outcome
    reason: str
    """Why it failed, in one line; empty when it did not."""
    env_steps: int
    learner_steps: int
    elapsed_s: float
    """Time in which it flew, in all parts of the run."""


class _Row(NamedTuple):
    """A report with the moment at which it came."""

    report: Report
    elapsed_s: float
    env_steps: float
    learner_step: float
    unix_s: float


class Course:
    """The processes of one run and what they report."""

    def __init__(
        self,
        config: Config,
        run: Path,
        collector: ReportCollector,
        start: Start,
        origin: Origin,
        part: int,
        more: Callable[[], Sequence[Role]] = tuple,
        tend: Callable[[], None] = lambda: None,
    ) -> None:
        """Takes what the run is made of; nothing is started yet.

        Args:
            config: the settings.
            run: the run folder.
            collector: takes the roles' reports; `go` closes it.
            start: starts a role.
            origin: what earlier parts of a resumed run have done.
            part: how often the run was resumed.
            more: returns further roles for which there is room now; asked once a second.
            tend: looks after what the roles need besides; called as often, while the run goes on.
        """
        self._config, self._run, self._collector = config, run, collector
        self._start_role, self._part, self._more, self._tend = start, part, more, tend
        self._supervisor = Supervisor(roles_of(config), self._start, config.launch)
        self._standing = Standing(config, time.monotonic(), origin)
        self._metrics: MetricsWriter | None = None
        self._early_rows: list[_Row] = []
        self._thinner = RowThinner(config.launch.dense_rows_s)
        self._status, self._lost_writes = StatusFile(run), LostWrites()
        self._status_due_s = self._growth_due_s = 0.0

    def go(self, view: View) -> Ended:
        """Starts the roles, watches them until a limit, Ctrl-C or a role that is given up, and ends them."""
        try:
            with view:
                outcome, reason = self.follow(view)
        finally:
            is_killed = self.end()
            self._collector.close()
        if is_killed and outcome == "completed":  # its last files may be missing, and whoever pressed Ctrl-C wants out
            outcome, reason = "interrupted", "interrupted while it ended"
        return Ended(outcome, reason, *self.counters())

    def follow(self, view: View) -> tuple[Outcome, str]:
        """Watches the run until it is over."""
        try:
            self._supervisor.start(time.monotonic())
            while not (self._standing.is_over or self._supervisor.is_done("learner")):
                self._take_reports(0.1)
                self._supervisor.watch(self._standing.now_s)
                self._tend_and_grow()
                view.show(self._standing, self._supervisor.watched)
        except KeyboardInterrupt:
            return "interrupted", "interrupted"
        except RoleFailedError as error:
            return "failed", str(error)
        return "completed", ""

    def counters(self) -> tuple[int, int, float]:
        """Returns environment steps, updates and elapsed seconds of the whole run."""
        return int(self._standing.env_steps), int(self._standing.learner_step), self._standing.elapsed_s

    def end(self) -> bool:
        """Stops the roles, the replay last, and kills what outlives its grace; returns whether Ctrl-C cut it short."""
        is_cut = False
        try:
            watched_roles = self._supervisor.watched.items()
            replays = [name for name, watched in watched_roles if watched.role.kind == "replay"]
            self._end([name for name, _ in watched_roles if name not in replays], self._config.launch.grace_s)
            self._end(replays, self._config.launch.grace_s)
        except KeyboardInterrupt:
            is_cut = True
            _log.warning("interrupted while the roles end: killing them")
        finally:
            for watched in self._supervisor.watched.values():
                if watched.handle is not None:
                    watched.handle.kill()
            for row in self._thinner.rest():
                self._append(row)
            if self._metrics is None:
                self._write_early_rows()
            self._write_status(has_ended=True)
            if self._metrics is not None:
                self._metrics.close()
        return is_cut

    def _start(self, role: Role, restarts: int) -> Handle:
        return self._start_role(role, incarnation_of(self._part, restarts), int(self._standing.env_steps))

    def _tend_and_grow(self) -> None:
        if self._standing.now_s < self._growth_due_s:
            return
        self._growth_due_s = self._standing.now_s + GROWTH_PERIOD_S
        self._tend()
        for role in self._more():
            self._collector.admit(role.name)
            self._standing.add(role)
            self._supervisor.add(role, self._standing.now_s)

    def _take_reports(self, timeout_s: float) -> None:
        reports = self._collector.poll(timeout_s)
        now_s = self._standing.now_s = time.monotonic()
        for report in reports:
            self._standing.take(report, now_s)
            self._supervisor.heard(report.role, report.pid, now_s)
            row = self._thinner.take(report, self._standing.elapsed_s)
            if row is not None:
                self._append(row)
        if now_s >= self._status_due_s:
            self._status_due_s = now_s + STATUS_PERIOD_S
            self._standing.look(self._supervisor.watched)
            self._write_status(has_ended=False)

    def _append(self, report: Report) -> None:
        """Writes a report as a row; those of the start wait until the run is under way.

        What writes them takes 2 s to import, which on few cores would come out of the time until it learns.
        """
        standing = self._standing
        row = _Row(report, standing.elapsed_s, standing.env_steps, standing.learner_step, time.time())
        if self._metrics is not None:
            self._write(self._metrics, row)
            return
        self._early_rows.append(row)
        if standing.is_under_way or len(self._early_rows) >= MANY_ROWS:
            self._write_early_rows()

    def _write_early_rows(self) -> None:
        from apex_bat.recording.metrics import MetricsWriter
        from apex_bat.recording.training import TrainingRecording

        training = TrainingRecording(self._config, self._run) if self._config.recording.curves else None
        self._metrics = MetricsWriter(self._run / "metrics", training)
        rows, self._early_rows = self._early_rows, []
        for row in rows:
            self._write(self._metrics, row)

    def _write(self, metrics: MetricsWriter, row: _Row) -> None:
        with self._lost_writes.borne():
            metrics.append(*row)

    def _write_status(self, *, has_ended: bool) -> None:
        with self._lost_writes.borne():
            self._status.write(
                self._standing, self._supervisor.watched, has_ended=has_ended,
                refused_reports=self._collector.refusals.counts,
            )  # fmt: skip

    def _end(self, names: Sequence[str], grace_s: float) -> None:
        running = self._supervisor.stop(names)
        deadline_s = time.monotonic() + grace_s
        while running and time.monotonic() < deadline_s:
            self._take_reports(0.05)
            for watched in running:
                ended = watched.handle.poll() if watched.handle is not None else None
                if ended is not None:
                    watched.handle, watched.is_done = None, True
            running = [watched for watched in running if watched.handle is not None]
        for watched in running:
            _log.warning("%s: did not end within %g s; killed", watched.role.name, grace_s)
