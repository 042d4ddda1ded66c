"""A process in reserve for a role whose imports take long, so that its restart does not wait for them."""

from __future__ import annotations

import logging
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress

_log = logging.getLogger(__name__)
AFTER_S = 10.0
"""How long a role has worked before a process is prepared: the start of a run has other use for the cores."""
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
        self._tried_s = float("-inf")

    def tend(self) -> None:
        """Starts a process if there is none; where the machine cannot, tries again after `AFTER_S`."""
        if self._process is not None and self._process.poll() is None:
            return
        if self._clock() - self._tried_s < AFTER_S:
            return
        self._tried_s = self._clock()
        self._release()
        try:
            self._process = self._start()
        except OSError as error:
            _log.warning("no process in reserve: %s", error.strerror or error)

    def take(self) -> subprocess.Popen[bytes] | None:
        """Hands the process over; None if there is none, or it has ended."""
        process, self._process = self._process, None
        if process is not None and process.poll() is not None:
            _let_go(process)
            return None
        return process

    def close(self) -> None:
        """Ends the process. May be called twice."""
        self._release()

    def _release(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        _let_go(process)
        try:
            process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            with suppress(subprocess.TimeoutExpired):
                process.wait(CLOSE_S)


def _let_go(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        with suppress(OSError):
            process.stdin.close()
