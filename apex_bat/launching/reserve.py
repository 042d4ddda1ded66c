"""A process in reserve for a role whose imports take long, so that its restart does not wait for them."""

from __future__ import annotations

import logging
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress

import psutil

_log = logging.getLogger(__name__)
AFTER_S = 10.0
"""How long a role has worked before a process is prepared: the start of a run has other use for the cores."""
MOST_WAIT_S = 600.0
"""Between two attempts, where each process dies: the machine may be short of memory."""
CLOSE_S = 2.0
"""How long the process may take to see that it is not needed; one that still imports is killed."""


class Reserve:
    """At most one process of a role that has imported all it needs and waits for the life that it is to begin."""

    def __init__(
        self, start: Callable[[], subprocess.Popen[bytes]], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`start` starts such a process; it is called when `tend` finds none."""
        self._start, self._clock = start, clock
        self._process: subprocess.Popen[bytes] | None = None
        self._due_s, self._wait_s = clock(), AFTER_S
        self._is_over = False

    def tend(self) -> None:
        """Starts a process if there is none; after one that died, or could not be started, not at once."""
        if self._is_over:
            return
        if self._process is not None:
            if self._process.poll() is None:
                return
            self._miss(f"ended with exit code {self._process.returncode}")
        if self._clock() < self._due_s:
            return
        try:
            self._process = self._start()
        except OSError as error:
            self._miss(error.strerror or str(error))

    def take(self) -> subprocess.Popen[bytes] | None:
        """Hands the process over; None if there is none, or it has ended or was stopped by a signal."""
        process, self._process = self._process, None
        if process is None:
            return None
        if process.poll() is None and not _is_stopped(process.pid):
            self._due_s, self._wait_s = self._clock(), AFTER_S
            return process
        process.kill()
        _release(process)
        return None

    def let_go(self) -> None:
        """Lets the process end, and starts no other; returns at once."""
        self._is_over = True
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def close(self) -> None:
        """Ends the process, and starts no other. May be called twice."""
        self.let_go()
        process, self._process = self._process, None
        if process is not None:
            _release(process)

    def _miss(self, reason: str) -> None:
        _log.warning("the process in reserve: %s; another one is tried in %g s", reason, self._wait_s)
        if self._process is not None:
            _release(self._process)
        self._process = None
        self._due_s, self._wait_s = self._clock() + self._wait_s, min(2.0 * self._wait_s, MOST_WAIT_S)


def _release(process: subprocess.Popen[bytes]) -> None:
    """Waits for a process that was let go, and kills one that does not see it."""
    if process.stdin is not None:
        with suppress(OSError):
            process.stdin.close()
    try:
        process.wait(CLOSE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        with suppress(subprocess.TimeoutExpired):
            process.wait(CLOSE_S)


def _is_stopped(pid: int) -> bool:
    with suppress(psutil.Error):
        return bool(psutil.Process(pid).status() == psutil.STATUS_STOPPED)
    return True
