"""When a replay server writes its snapshots: one a period while it serves, and one when it is told to."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.snapshot import SnapshotWriter, read_snapshot

logger = logging.getLogger(__name__)

COUNTS = ("snapshots", "failed_snapshots")


class Snapshots:
    """The snapshots of one buffer.

    Args:
        buffer: what they are of.
        path: the file; None: there are none.
        period_s: from the end of one to the begin of the next; 0: only when told to.
        clock: seconds, monotonic.

    Attributes:
        counts: files written and failed while serving, by the names of `COUNTS`.
    """

    def __init__(self, buffer: ReplayBuffer, path: Path | None, period_s: float, clock: Callable[[], float]) -> None:
        self._buffer, self._path, self._clock = buffer, path, clock
        self._period_s = period_s or math.inf
        self._writer: SnapshotWriter | None = None
        self._due_s = clock() + self._period_s
        self.counts = dict.fromkeys(COUNTS, 0)

    def tend(self, state: Callable[[], dict[str, Any]]) -> None:
        """Begins a snapshot when it is due, and goes on with one that is being written.

        Args:
            state: returns what to keep beside the buffer.
        """
        if self._path is None:
            return
        if self._writer is None:
            if self._clock() >= self._due_s:
                self._writer = SnapshotWriter(self._buffer, self._path)
            return
        try:
            if not self._writer.advance(state):
                return
            self.counts["snapshots"] += 1
        except OSError as error:
            self.counts["failed_snapshots"] += 1
            logger.error("the snapshot of the replay failed, the one before is kept: %s", error)
        self._writer = None
        self._due_s = self._clock() + self._period_s

    def hasten(self) -> None:
        """Makes the next one due now."""
        self._due_s = self._clock()

    def save(self, state: Callable[[], dict[str, Any]]) -> None:
        """Writes a snapshot and waits for it. Raises OSError if that fails, ValueError without a path."""
        if self._path is None:
            raise ValueError("this server has no snapshot_path")
        self.drop()
        SnapshotWriter(self._buffer, self._path).advance(state, wait=True)

    def read(self) -> tuple[dict[str, Any], Path]:
        """Fills the buffer from the newest sound snapshot; returns what was kept beside, and the file.

        Raises:
            FileNotFoundError: there is none.
            SnapshotError: none is sound, or it does not fit the settings.
        """
        if self._path is None:
            raise FileNotFoundError("this server has no snapshot_path")
        return read_snapshot(self._path, self._buffer)

    def drop(self) -> None:
        """Gives up the one that is being written."""
        if self._writer is not None:
            self._writer.abandon()
            self._writer = None
