"""A snapshot is looked through without a buffer: facts, hash, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import Config
from apex_bat.experience import Chunk
from apex_bat.replay.snapshot import SnapshotError, SnapshotWriter, previous_of, read_snapshot
from apex_bat.replay.store import ReplayStore
from apex_bat.replay.verification import verify

MakeChunk = Callable[..., Chunk]


def filled(config: Config, make_chunk: MakeChunk, inserts: int = 130) -> ReplayStore:
    store = ReplayStore(config, np.random.default_rng(0))
    for _ in range(inserts):
        store.add("actor-0", 0, [make_chunk()])
    return store


def save(store: ReplayStore, path: Path) -> None:
    assert SnapshotWriter(store.buffer, path).advance(store.state, wait=True)


def test_facts_are_those_of_the_replay(config: Config, make_chunk: MakeChunk, tmp_path: Path) -> None:
    path = tmp_path / "replay.snapshot"
    assert verify(path) is None
    store = filled(config, make_chunk)
    save(store, path)
    facts = verify(path)
    assert facts is not None
    assert (facts.transitions, facts.inserted, facts.refused) == (len(store.buffer), 1300, "")
    assert facts.fits["capacity"] == 1000


def test_hash_is_that_of_the_content(config: Config, make_chunk: MakeChunk, tmp_path: Path) -> None:
    first, second, third = (tmp_path / name for name in ("first", "second", "third"))
    store = filled(config, make_chunk)
    save(store, first)
    restored = ReplayStore(config, np.random.default_rng(5))
    restored.restore(read_snapshot(first, restored.buffer)[0])
    save(restored, second)
    restored.update(1, np.array([1299]), np.array([3.0], np.float32))
    save(restored, third)
    hashes = [facts.sha256 for path in (first, second, third) if (facts := verify(path)) is not None]
    assert hashes[0] == hashes[1] != hashes[2]


@pytest.mark.parametrize("where", [0.2, 0.6, 0.999])
def test_a_changed_byte_is_noticed_and_the_one_before_is_taken(
    where: float, config: Config, make_chunk: MakeChunk, tmp_path: Path
) -> None:
    path = tmp_path / "replay.snapshot"
    store = filled(config, make_chunk)
    save(store, path)
    save(store, path)
    data = bytearray(path.read_bytes())
    data[int(where * len(data))] ^= 1
    path.write_bytes(data)
    facts = verify(path)
    assert facts is not None
    assert facts.path == previous_of(path)
    assert str(path) in facts.refused
    previous_of(path).write_bytes(b"")
    with pytest.raises(SnapshotError, match="damaged"):
        verify(path)
