"""Counts what is refused, by reason, and says so in the log without flooding it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

LOG_PERIOD_S = 10.0  # at most one line a reason in this time: a flood of bad messages must not fill the disk


class Refusals:
    """Counters of refusals.

    Args:
        logger: where they are told.
        clock: seconds, monotonic.

    Attributes:
        counts: refusals so far by reason. Callers give few distinct reasons.
    """

    def __init__(self, logger: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self.counts: dict[str, int] = {}
        self._logger = logger
        self._clock = clock
        self._next_log_s: dict[str, float] = {}
        self._untold: dict[str, int] = {}

    @property
    def total(self) -> int:
        """All refusals so far."""
        return sum(self.counts.values())

    def count(self, reason: str, detail: str) -> None:
        """Counts one refusal; its detail is logged unless the reason was logged just now."""
        self.counts[reason] = self.counts.get(reason, 0) + 1
        self._untold[reason] = self._untold.get(reason, 0) + 1
        if self._clock() >= self._next_log_s.get(reason, float("-inf")):
            self._logger.warning("refused (%s, %d since the last line): %s", reason, self._untold[reason], detail)
            self._next_log_s[reason] = self._clock() + LOG_PERIOD_S
            self._untold[reason] = 0
