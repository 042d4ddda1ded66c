"""Watching roles and starting them again: the policy, whatever the roles run on.

A role that ends unasked is started again after a backoff that doubles with each quick failure; one that stays silent
is killed first. A role that fails too often in a row, or says that trying again is useless, ends the run. While the
machine cannot start a process, the role is tried again for as long as it takes. Time in which the launcher itself did
not look, because it was stopped or the machine slept, is no silence of the roles.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol

from apex_bat.config.settings import Launch
from apex_bat.roles.plan import Role

USELESS = 2
"""Exit code by which a role says that starting it again would fail in the same way."""
MAX_BACKOFF_S = 30.0
MOST_DOUBLINGS = 64
"""How often the backoff doubles at most: beyond any that is allowed, and far below what a float holds."""
LATE_LOOK_S = 2.0
"""What counts of the time between two looks at most, in s; what is longer was the launcher's own silence."""
TEMPORARY = {
    getattr(errno, name, None) for name in ("EAGAIN", "ENOMEM", "EMFILE", "ENFILE", "ENOSPC", "EDQUOT", "EINTR")
}
"""Errors of starting a process that pass by themselves: the machine is out of memory, processes, files or disk."""
_log = logging.getLogger(__name__)


class Exit(NamedTuple):
    """How a role ended."""

    code: int | None
    """Exit code; negative: the signal that killed it; None: the machine could not start it."""
    detail: str
    """What it said last, for the one line that a person reads."""
    is_lost: bool = False
    """Whether its machine was lost with it, which is no failure of the role."""


class Handle(Protocol):
    """A started role."""

    @property
    def pid(self) -> int:
        """Number of its process; 0 while it has none."""

    @property
    def waiting(self) -> str:
        """For what it waits before its process can begin; empty once that was asked for."""

    def poll(self) -> Exit | None:
        """Returns how it ended, or None while it runs."""

    def stop(self) -> None:
        """Asks it to end."""

    def kill(self) -> None:
        """Ends it at once."""


class RoleFailedError(RuntimeError):
    """A role failed beyond its budget; the text says which, why, and where its log is."""


class Watched:
    """One role of the run and its present process."""

    def __init__(self, role: Role) -> None:
        self.role = role
        self.handle: Handle | None = None
        self.restarts = 0
        self.failures_in_a_row = 0
        """Quick failures, and starts without a report, since it last worked for a while."""
        self.failed_starts = 0
        """How often in a row the machine could not start it."""
        self.was_mute = False
        """Whether the present process was killed because it was never heard."""
        self.started_s = 0.0
        self.heard_s: float | None = None
        """When this process was heard last; None before its first report."""
        self.due_s: float | None = None
        """When it is to be started again; None while it runs or when it is done."""
        self.is_done = False
        self.reason = ""
        """Why it does not run now; empty while it runs."""


class Supervisor:
    """Starts the roles, restarts what fails and stops them all."""

    def __init__(self, roles: Iterable[Role], start: Callable[[Role, int], Handle], launch: Launch) -> None:
        """`start(role, incarnation)` starts a role; times are handed in, so that tests can drive them."""
        self.watched = {role.name: Watched(role) for role in roles}
        self._start = start
        self._launch = launch
        self._looked_s = 0.0

    def start(self, now_s: float) -> None:
        """Starts every role."""
        self._looked_s = now_s
        for watched in self.watched.values():
            self._begin(watched, now_s)

    def add(self, role: Role, now_s: float) -> None:
        """Starts a role more."""
        self.watched[role.name] = Watched(role)
        self._begin(self.watched[role.name], now_s)

    def heard(self, name: str, pid: int, now_s: float) -> None:
        """Notes a sign of life; one of a former process is ignored."""
        watched = self.watched.get(name)
        if watched is not None and watched.handle is not None and watched.handle.pid == pid:
            watched.heard_s, watched.failed_starts = now_s, 0

    def watch(self, now_s: float) -> None:
        """Notices what ended or fell silent, and starts again what is due.

        Raises:
            RoleFailedError: a role is beyond its budget.
        """
        missed_s = now_s - self._looked_s - LATE_LOOK_S
        self._looked_s = now_s
        for watched in self.watched.values():
            if missed_s > 0.0:
                _forgive(watched, missed_s, now_s)
            if watched.handle is not None:
                self._check(watched, watched.handle, now_s)
            elif watched.due_s is not None and now_s >= watched.due_s:
                watched.restarts += 1
                self._begin(watched, now_s)

    def is_done(self, name: str) -> bool:
        """Whether a role has ended by itself, with exit code 0."""
        return self.watched[name].is_done

    def stop(self, names: Iterable[str]) -> list[Watched]:
        """Asks some roles to end and returns those that run; they are not started again."""
        chosen = [self.watched[name] for name in names]
        for watched in chosen:
            watched.due_s = None
            if watched.handle is not None:
                watched.handle.stop()
        return [watched for watched in chosen if watched.handle is not None]

    def _begin(self, watched: Watched, now_s: float) -> None:
        watched.started_s, watched.heard_s, watched.due_s, watched.reason = now_s, None, None, ""
        watched.was_mute = False
        try:
            watched.handle = self._start(watched.role, watched.restarts)
            if not watched.handle.waiting:
                watched.failed_starts = 0
        except OSError as error:
            if error.errno not in TEMPORARY:
                raise RoleFailedError(f"{watched.role.name}: cannot be started: {error.strerror or error}") from error
            self._fail(watched, Exit(None, error.strerror or str(error)), now_s)

    def _check(self, watched: Watched, handle: Handle, now_s: float) -> None:
        ended = handle.poll()
        if ended is None:
            self._check_silence(watched, handle, now_s)
        else:
            watched.handle = None
            watched.is_done = ended.code == 0
            if not watched.is_done:
                self._fail(watched, ended, now_s)

    def _check_silence(self, watched: Watched, handle: Handle, now_s: float) -> None:
        if handle.waiting:  # for a place, which is nobody's silence
            watched.started_s = now_s
            return
        is_new = watched.heard_s is None
        silent_s = now_s - (watched.started_s if watched.heard_s is None else watched.heard_s)
        if silent_s > (self._launch.start_timeout_s if is_new else self._launch.heartbeat_timeout_s):
            what = "not heard since its start" if is_new else "silent"
            _log.warning("%s: %s for %.0f s; killed and replaced", watched.role.name, what, silent_s)
            watched.was_mute = watched.was_mute or is_new
            watched.heard_s = now_s  # a process that cannot even be killed is not tried again at each look
            handle.kill()

    def _fail(self, watched: Watched, ended: Exit, now_s: float) -> None:
        if ended.code is None or ended.is_lost:
            watched.failed_starts += 1
            doublings = watched.failed_starts - 1
        else:
            is_quick = watched.was_mute or now_s - watched.started_s < self._launch.quick_failure_s
            watched.failures_in_a_row = watched.failures_in_a_row + 1 if is_quick else 1
            self._judge(watched, ended)
            doublings = watched.failures_in_a_row - 1
        wait_s = min(self._launch.backoff_s * 2.0 ** min(doublings, MOST_DOUBLINGS), MAX_BACKOFF_S)
        watched.due_s, watched.reason = now_s + wait_s, describe(ended)
        _log.warning("%s: %s; starts again in %.1f s", watched.role.name, describe(ended), wait_s)

    def _judge(self, watched: Watched, ended: Exit) -> None:
        name = watched.role.name
        if ended.code == USELESS:
            raise RoleFailedError(ended.detail or f"{name} cannot work with these settings")
        if watched.failures_in_a_row > self._launch.max_failures:
            raise RoleFailedError(
                f"{name}: given up after {watched.failures_in_a_row} quick failures, the last: {describe(ended)}"
            )


def _forgive(watched: Watched, missed_s: float, now_s: float) -> None:
    """Moves the times of a role by what the launcher missed; what it has just heard stays heard now."""
    watched.started_s = min(watched.started_s + missed_s, now_s)
    if watched.heard_s is not None:
        watched.heard_s = min(watched.heard_s + missed_s, now_s)


def describe(ended: Exit) -> str:
    """Returns a few words on how a role ended."""
    if ended.is_lost:
        return f"lost with its machine: {ended.detail}"
    if ended.code is None:
        return f"cannot be started: {ended.detail}"
    if ended.code < 0:
        return f"killed by signal {-ended.code}"
    return f"failed with exit code {ended.code}" + (f": {ended.detail}" if ended.detail else "")
