"""Whether a run moves on, and if not, who waits for whom."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

_log = logging.getLogger(__name__)


class Progress:
    """Notes when environment steps or updates grew last, and says so, once a period, when that is long ago."""

    def __init__(self, stall_s: float, now_s: float) -> None:
        """`stall_s`: how long nothing may grow."""
        self._stall_s = stall_s
        self._counters = (0.0, 0.0)
        self._grown_s = now_s
        self._said_s = now_s

    def take(self, env_steps: float, updates: float, now_s: float) -> None:
        """Notes the counters of the run. Any change counts: a learner that goes back to a checkpoint goes on, too."""
        if (env_steps, updates) != self._counters:
            self._counters, self._grown_s, self._said_s = (env_steps, updates), now_s, now_s

    def stall(self, roles: Iterable[Mapping[str, Any]], now_s: float) -> str:
        """Returns since when the run stands still and what each role says; empty while it moves.

        Args:
            roles: rows of the status.
            now_s: the time, as ever.
        """
        silent_s = now_s - self._grown_s
        if silent_s < self._stall_s:
            return ""
        states = "; ".join(f"{row['role']}: {row['state']}" for row in roles)
        text = f"no environment step and no update for {silent_s:.0f} s ({states})"
        if now_s - self._said_s >= self._stall_s:
            self._said_s = now_s
            _log.warning("%s", text)
        return text
