"""What a snapshot of a replay of 1,000,000 transitions costs the server that goes on serving.

A turn is what a busy server does: one insert of 50, one batch of 64, a look at the snapshot. Turns are timed one by one
while a snapshot is written and, as long, while none is. Run it with `apex-bat bench snapshot`.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.heap import keep_freed_memory
from apex_bat.replay.saving import Snapshots
from benchmarks.replay import INSERT, Filled, Record, summary

CAPACITY = 1_000_000
BATCH = 64
SNAPSHOTS = 5


def measure() -> list[Record]:
    """Returns the records that `apex-bat bench snapshot` writes."""
    keep_freed_memory()  # as the server does
    full = Filled(CAPACITY)
    insert, sample = full.insert(INSERT), full.sample(BATCH)

    def serve() -> None:
        insert()
        sample()

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "replay.snapshot"
        rounds = [_round(full.buffer, serve, path) for _ in range(SNAPSHOTS)]
        size_mb = path.stat().st_size / 1e6
    halts_ms, usual_ms, writing_s, slower = (list(values) for values in zip(*rounds, strict=True))
    return [
        summary("snapshot.longest_turn_ms", "ms", halts_ms),
        summary("snapshot.longest_turn_without_ms", "ms", usual_ms),
        summary("snapshot.writing_s", "s", writing_s),
        summary("snapshot.turns_with_over_without", "1", slower),
        summary("snapshot.file_mb", "MB", [size_mb]),
    ]


def _round(buffer: ReplayBuffer, serve: Callable[[], None], path: Path) -> tuple[float, float, float, float]:
    """Returns the longest turn with a snapshot and without one [ms], how long it took [s], and the ratio of rates."""
    snapshots = Snapshots(buffer, path, 0.0, time.monotonic)
    snapshots.hasten()

    def serve_and_tend() -> None:
        serve()
        snapshots.tend(dict)

    begun_s, turns_s = time.perf_counter(), list[float]()
    while not snapshots.counts["snapshots"]:
        turns_s.append(_timed(serve_and_tend))
        if snapshots.counts["failed_snapshots"]:
            raise OSError(f"{path}: the snapshot could not be written")
    writing_s = time.perf_counter() - begun_s
    begun_s, usual_s = time.perf_counter(), list[float]()
    while time.perf_counter() - begun_s < writing_s:
        usual_s.append(_timed(serve))
    return 1000.0 * max(turns_s), 1000.0 * max(usual_s), writing_s, len(turns_s) / len(usual_s)


def _timed(action: Callable[[], None]) -> float:
    begun_s = time.perf_counter()
    action()
    return time.perf_counter() - begun_s


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
