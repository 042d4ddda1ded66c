"""recordings/training.rrd: the course of a training, written while it runs and readable after a kill."""

from __future__ import annotations

import json
import logging
import time
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import rerun as rr

from apex_bat.config import Config
from apex_bat.recording.blueprints import training_blueprint
from apex_bat.recording.curves import TRAINING_APPLICATION_ID, TrainingCurves

TRAINING_RECORDING = "training.rrd"
"""The recording of the training itself, which is no flight."""
FLUSH_PERIOD_S = 10.0
"""Seconds between writes for up to ten roles; each write of an entity takes 1 to 2 KB, so that more wait longer."""
FLUSH_TIMEOUT_S = 10.0
_log = logging.getLogger(__name__)


class TrainingRecording:
    """The file of one run. What it cannot write it leaves out: a training never fails for it."""

    def __init__(self, config: Config, run: Path) -> None:
        """Begins the file with the rows of an earlier part of the run, if there is one."""
        self._recording = rr.RecordingStream(TRAINING_APPLICATION_ID, recording_id=uuid.uuid4())
        self._period_s = FLUSH_PERIOD_S * max(1.0, config.actors / 10.0)
        self._flushed_s = time.monotonic()
        self._curves: TrainingCurves | None = None
        try:
            self._recording.save(run / "recordings" / TRAINING_RECORDING, training_blueprint(config))
        except RuntimeError as error:
            _log.error("the training is not recorded: %s", error)
            return
        self._curves = TrainingCurves(self._recording, config, run.name)
        for row in rows_of(run):
            self._curves.take(row)

    def take(self, row: Mapping[str, Any]) -> None:
        """Takes a row of metrics, and writes those gathered when the last write is ten seconds old."""
        if self._curves is None:
            return
        self._curves.take(row)
        if time.monotonic() - self._flushed_s >= self._period_s:
            self._flush()

    def close(self) -> None:
        """Writes the rest and the index."""
        self._flush()
        self._recording.disconnect()

    def _flush(self) -> None:
        self._flushed_s = time.monotonic()
        if self._curves is None:
            return
        try:
            self._curves.flush()
            self._recording.flush(timeout_sec=FLUSH_TIMEOUT_S)
        except RuntimeError as error:  # rerun's, for a full disk
            _log.error("the training is no longer recorded: %s", error)
            self._curves = None


def rows_of(run: Path) -> Iterator[dict[str, Any]]:
    """Yields the rows of all metrics of a run, one role after the other, each in the order of time."""
    for path in sorted((run / "metrics").glob("*.jsonl")):
        with path.open("rb") as lines:
            for line in lines:
                row = row_of(line)
                if row is not None:
                    yield row


def row_of(line: bytes) -> dict[str, Any] | None:
    """Returns the row of metrics in a line; None for one that is still being written, or torn by a crash."""
    if not line.endswith(b"\n"):
        return None
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) else None
