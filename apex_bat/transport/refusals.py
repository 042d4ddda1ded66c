"""Counts what is refused, by reason, and says so in the log without flooding it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

LOG_PERIOD_S = 10.0  # at most one line a reason in this time: a flood of bad messages must not fill the disk

REASONS: dict[str, str] = {
    "foreign": "bytes that do not start as a message of apex_bat",
    "protocol": "another version of the protocol",
    "generation": "not the generation of this address: a former run, or somebody who was not told it",
    "size": "sizes that do not add up, or a message cut short",
    "parts": "more or fewer parts than the one that a message has",
    "header": "a header that cannot be decoded or breaks its limits",
    "shape": "shapes that do not fit the bytes",
    "value": "values that are not finite or out of range",
    "unexpected": "a right message at the wrong socket",
    "superseded": "an actor whose place another incarnation has taken",
    "flood": "more sample requests, or subscribers, than may wait",
    "batch_size": "a sample request for another batch size than the settings give",
    "chunk": "a chunk that does not fit this replay",
    "role": "a report of a role that the run does not have",
    "key": "a client whose key is not listed",
    "handshake": "a connection that ended, or stayed silent, before it had introduced itself",
}
"""Every reason for which a listening socket refuses something, and what it means."""

PUBLISHER_REASONS = (
    "foreign", "protocol", "generation", "size", "parts", "header", "shape", "value", "unexpected", "flood", "key",
    "handshake",
)  # fmt: skip
"""Those for which a publisher of weights does."""


class Refusals:
    """Counters of refusals. Threads may share one.

    Args:
        logger: where they are told.
        clock: seconds, monotonic.

    Attributes:
        counts: refusals so far by reason, the keys of `REASONS`.
    """

    def __init__(self, logger: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self.counts: dict[str, int] = {}
        self._logger = logger
        self._clock = clock
        self._lock = threading.Lock()
        self._next_log_s: dict[str, float] = {}
        self._untold: dict[str, int] = {}

    @property
    def total(self) -> int:
        """All refusals so far."""
        with self._lock:
            return sum(self.counts.values())

    def count(self, reason: str, detail: str) -> None:
        """Counts one refusal; its detail is logged unless the reason was logged just now.

        Args:
            reason: a key of `REASONS`.
            detail: what was refused; may hold what a stranger sent, and is logged as one line.
        """
        with self._lock:
            self.counts[reason] = self.counts.get(reason, 0) + 1
            self._untold[reason] = self._untold.get(reason, 0) + 1
            now_s = self._clock()
            if now_s < self._next_log_s.get(reason, float("-inf")):
                return
            untold, self._untold[reason] = self._untold[reason], 0
            self._next_log_s[reason] = now_s + LOG_PERIOD_S
        printable = "".join(c if c.isprintable() else "?" for c in detail[:500])  # no escapes into a terminal
        self._logger.warning("refused (%s, %d since the last line): %s", reason, untold, printable)
