"""Training on this machine: every role a process, watched until a limit is reached, Ctrl-C, or a role is given up."""

from __future__ import annotations

import json
import logging
import os
import secrets
import shutil
import signal
import socket
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Literal, NamedTuple

import msgspec

from apex_bat.config import Config
from apex_bat.launching.live import View
from apex_bat.launching.processes import RoleProcess
from apex_bat.launching.rows import RowThinner
from apex_bat.launching.standing import NEW_RUN, Origin, Standing
from apex_bat.launching.status import STATUS
from apex_bat.launching.supervisor import RoleFailedError, Supervisor
from apex_bat.roles.logs import launcher_log
from apex_bat.roles.plan import Addresses, Role, incarnation_of, roles_of
from apex_bat.roles.process import ADDRESSES
from apex_bat.roles.resources import began_unix_s, own_resources
from apex_bat.storage import StorageError, write_text
from apex_bat.transport.messages import Report
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import TransportError, load_keys

if TYPE_CHECKING:
    from apex_bat.recording.metrics import MetricsWriter

STATUS_PERIOD_S = 1.0
MANY_ROWS = 1000
"""Rows of roles that do not come to fly, after which these are written all the same."""
COMPLAINT_PERIOD_S = 60.0
"""How often a disk that takes nothing is complained of."""
_MAX_IPC_PATH = 90  # a Unix socket's path holds 107 bytes
_log = logging.getLogger(__name__)

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


def train(
    config: Config, run: Path, view: View, *, origin: Origin = NEW_RUN, part: int = 0, lock: int | None = None
) -> Ended:
    """Trains in a run folder made by `runs.create` until a limit, Ctrl-C or a role that is given up.

    Args:
        config: the settings.
        run: the run folder.
        view: shows the run.
        origin: what earlier parts of a resumed run have done.
        part: how often the run was resumed.
        lock: file descriptor of the run's lock, for the roles to keep open.
    """
    with _terminable(), launcher_log(run, config.launch), _addresses(config, run) as addresses:
        write_text(run / ADDRESSES, msgspec.json.encode(addresses).decode(), mode=0o600)  # its numbers let one in
        keys = load_keys(Path(config.transport.keys)) if config.transport.keys else None
        collector = ReportCollector(
            addresses.reports,
            keys=keys,
            generation=addresses.reports_generation,
            roles=[role.name for role in roles_of(config)],
        )
        launch = _Launch(config, run, collector, origin, part, lock)
        try:
            with view:
                outcome, reason = launch.follow(view)
        finally:
            is_killed = launch.end()
            collector.close()
        if is_killed and outcome == "completed":  # its last files may be missing, and whoever pressed Ctrl-C wants out
            outcome, reason = "interrupted", "interrupted while it ended"
        return Ended(outcome, reason, *launch.counters())


class _Launch:
    """The processes of one run and what they report."""

    def __init__(
        self, config: Config, run: Path, collector: ReportCollector, origin: Origin, part: int, lock: int | None
    ) -> None:
        self._config, self._run, self._collector, self._part, self._lock = config, run, collector, part, lock
        self._supervisor = Supervisor(roles_of(config), self._start, config.launch)
        self._standing = Standing(config, time.monotonic(), origin)
        self._metrics: MetricsWriter | None = None
        self._early_rows: list[Report] = []
        self._thinner = RowThinner(config.launch.dense_rows_s)
        self._began_unix_s = began_unix_s(os.getpid())
        self._status_due_s = self._complaint_due_s = 0.0
        self._lost_writes = 0
        self._has_ended = False

    def follow(self, view: View) -> tuple[Outcome, str]:
        """Watches the run until it is over."""
        try:
            self._supervisor.start(time.monotonic())
            while not (self._standing.is_over or self._supervisor.is_done("learner")):
                self._take_reports(0.1)
                self._supervisor.watch(self._standing.now_s)
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
            names = list(self._supervisor.watched)
            self._end([name for name in names if name != "replay"], self._config.launch.grace_s)
            self._end(["replay"], self._config.launch.grace_s)
        except KeyboardInterrupt:
            is_cut = True
            _log.warning("interrupted while the roles end: killing them")
        finally:
            for watched in self._supervisor.watched.values():
                if watched.handle is not None:
                    watched.handle.kill()
            self._has_ended = True
            for row in self._thinner.rest():
                self._append(row)
            if self._metrics is None:
                self._write_early_rows()
            with suppress(StorageError):
                self._write_status()
            if self._metrics is not None:
                self._metrics.close()
        return is_cut

    def _start(self, role: Role, incarnation: int) -> RoleProcess:
        threads = self._config.train.threads if role.kind == "learner" else 1
        return RoleProcess(
            role, self._run, incarnation_of(self._part, incarnation), threads, int(self._standing.env_steps), self._lock
        )

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
            with self._disk_may_be_full():
                self._write_status()

    def _append(self, row: Report) -> None:
        """Writes a row; those before the first environment step wait for it.

        What writes them takes 2 s to import, which on few cores would come out of the time until the bats fly.
        """
        standing = self._standing
        if self._metrics is None:
            self._early_rows.append(row)
            if standing.flying_since_s is not None or len(self._early_rows) >= MANY_ROWS:
                self._write_early_rows()
            return
        with self._disk_may_be_full():
            self._metrics.append(row, standing.elapsed_s, standing.env_steps, standing.learner_step)

    def _write_early_rows(self) -> None:
        from apex_bat.recording.metrics import MetricsWriter
        from apex_bat.recording.training import TrainingRecording

        training = TrainingRecording(self._config, self._run) if self._config.recording.curves else None
        self._metrics = MetricsWriter(self._run / "metrics", training)
        rows, self._early_rows = self._early_rows, []
        for row in rows:
            self._append(row)

    @contextmanager
    def _disk_may_be_full(self) -> Iterator[None]:
        """Lets the run go on without what the disk does not take, and says so once a minute."""
        try:
            yield
        except StorageError as error:
            self._lost_writes += 1
            if self._standing.now_s >= self._complaint_due_s:
                self._complaint_due_s = self._standing.now_s + COMPLAINT_PERIOD_S
                _log.error("%s; training goes on, and %d writes were lost so far", error, self._lost_writes)

    def _write_status(self) -> None:
        roles = self._standing.status(self._supervisor.watched)
        content = {
            "launcher_pid": os.getpid(), "launcher_began_unix_s": self._began_unix_s, "host": socket.gethostname(),
            "written_unix_s": time.time(), "ended": self._has_ended, "stall": self._standing.stall,
            "launcher_metrics": own_resources(), "refused_reports": self._collector.refusals.counts.copy(),
            "progress": self._standing.progress(), "roles": roles,
        }  # fmt: skip
        write_text(self._run / STATUS, json.dumps(content, indent=1))

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


def heeded(*names: str) -> list[signal.Signals]:
    """Returns those of some signals that this system has and that this process was not told to ignore.

    What `nohup` or a shell's background sets to be ignored stays ignored.
    """
    numbers: list[signal.Signals] = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]


@contextmanager
def _terminable() -> Iterator[None]:
    """Makes SIGTERM and a closed terminal end a run in the same way as Ctrl-C."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = heeded("SIGTERM", "SIGHUP")
    former = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextmanager
def _addresses(config: Config, run: Path) -> Iterator[Addresses]:
    """Yields the endpoints of a run; sockets of `ipc` lie in a folder that only this user can enter.

    Raises:
        TransportError: no port could be had.
    """
    if config.transport.host != "ipc":
        host, base_port = config.transport.host, config.transport.base_port
        ports = [base_port + i for i in range(3)] if base_port else _free_ports(host, 3)
        yield _with_generations([f"tcp://{host}:{port}" for port in ports])
        return
    folder = run.resolve() / "sockets"
    if len(os.fsencode(folder)) > _MAX_IPC_PATH:
        folder = Path(tempfile.mkdtemp(prefix="apex_bat-"))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(mode=0o700)
    try:
        yield _with_generations([f"ipc://{folder / name}" for name in ("replay", "weights", "reports")])
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _with_generations(endpoints: Sequence[str]) -> Addresses:
    """Returns the addresses of replay, weights and reports with generations that nobody can guess."""
    replay, weights, reports = (secrets.randbits(63) for _ in range(3))
    return Addresses(*endpoints, replay_generation=replay, weights_generation=weights, reports_generation=reports)


def _free_ports(host: str, number: int) -> list[int]:
    """Returns ports that are free now; another process could take one before the roles bind them."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for each in sockets:
            try:
                each.bind((host, 0))
            except OSError as error:
                raise TransportError(f"transport.host={host}: cannot listen there: {error.strerror or error}") from None
        return [each.getsockname()[1] for each in sockets]
