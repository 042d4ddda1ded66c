"""When snapshots are written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from apex_bat.experience import Chunk
from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.saving import Snapshots

MakeChunk = Callable[..., Chunk]
Until = Callable[..., None]


def state() -> dict[str, object]:
    return {"alpha": 0.6, "buffer": [0, 0, 0]}


def buffer() -> ReplayBuffer:
    return ReplayBuffer(50, 100, 3, 3, alpha=0.6)


def test_one_is_written_a_period_and_at_once_when_hastened(tmp_path: Path, until: Until) -> None:
    now = [0.0]
    snapshots = Snapshots(buffer(), tmp_path / "s", 60.0, lambda: now[0])
    snapshots.tend(state)
    assert not list(tmp_path.iterdir()), "nothing is due"
    for moment, number in ((60.0, 1), (120.0, 2)):
        now[0] = moment
        until(lambda number=number: snapshots.counts["snapshots"] == number, lambda: snapshots.tend(state))
    snapshots.hasten()
    until(lambda: snapshots.counts["snapshots"] == 3, lambda: snapshots.tend(state))
    assert (tmp_path / "s").exists()


def test_a_period_of_zero_writes_none_but_when_told(tmp_path: Path) -> None:
    snapshots = Snapshots(buffer(), tmp_path / "s", 0.0, lambda: 1e12)
    snapshots.tend(state)
    assert not list(tmp_path.iterdir())
    snapshots.save(state)
    assert snapshots.read()[1] == tmp_path / "s"


def test_a_failure_is_counted_and_tried_again(tmp_path: Path, until: Until) -> None:
    now = [0.0]
    snapshots = Snapshots(buffer(), tmp_path / "absent" / "s", 1.0, lambda: now[0])
    now[0] = 1.0
    until(lambda: snapshots.counts["failed_snapshots"] == 1, lambda: snapshots.tend(state))
    (tmp_path / "absent").mkdir()
    now[0] = 2.0
    until(lambda: snapshots.counts["snapshots"] == 1, lambda: snapshots.tend(state))


def test_without_a_path_there_are_none() -> None:
    snapshots = Snapshots(buffer(), None, 1.0, lambda: 1e12)
    snapshots.tend(state)
    with pytest.raises(ValueError, match="no snapshot_path"):
        snapshots.save(state)
    with pytest.raises(FileNotFoundError, match="no snapshot_path"):
        snapshots.read()


def test_what_was_read_fills_the_buffer(tmp_path: Path, make_chunk: MakeChunk) -> None:
    full, empty = buffer(), buffer()
    chunk = make_chunk(20)
    full.add([chunk], chunk.priorities + np.float32(0.1))
    kept = {"alpha": 0.6, "buffer": list(full.counters)}
    Snapshots(full, tmp_path / "s", 0.0, lambda: 0.0).save(lambda: kept)
    found, _ = Snapshots(empty, tmp_path / "s", 0.0, lambda: 0.0).read()
    assert found == kept
    assert empty.total == pytest.approx(full.total)
