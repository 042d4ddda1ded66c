"""Snapshots: what comes back is what was there, whatever happened meanwhile or to the file."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from apex_bat.experience import Chunk
from apex_bat.replay import snapshot
from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.snapshot import SnapshotError, SnapshotWriter, previous_of, read_snapshot
from apex_bat.replay.verification import verify

MakeChunk = Callable[..., Chunk]


def new_buffer(capacity: int = 200) -> ReplayBuffer:
    return ReplayBuffer(capacity, 300, memory_steps=3, heard_steps=3, alpha=0.6)


def add(buffer: ReplayBuffer, chunk: Chunk) -> None:
    buffer.add([chunk], chunk.priorities + np.float32(0.01), 2, 5)


def state_of(buffer: ReplayBuffer, **beside: object) -> Callable[[], dict[str, Any]]:
    return lambda: {"buffer": list(buffer.counters), "alpha": buffer.alpha} | beside


def save(buffer: ReplayBuffer, path: Path, **beside: object) -> None:
    assert SnapshotWriter(buffer, path).advance(state_of(buffer, **beside), wait=True)


def assert_equal(one: ReplayBuffer, other: ReplayBuffer) -> None:
    assert one.counters == other.counters
    drawn = [b.sample(256, 0.4, np.random.default_rng(1)) for b in (one, other)]
    for field, (left, right) in zip(
        drawn[0].batch._fields, zip(drawn[0].batch, drawn[1].batch, strict=True), strict=True
    ):
        np.testing.assert_equal(left, right, err_msg=field)
    np.testing.assert_array_equal(drawn[0].learner_steps, drawn[1].learner_steps)


@pytest.fixture(autouse=True)
def small_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshot, "SLICE_ROWS", 64)


@pytest.mark.parametrize("chunks", [1, 12, 60])
def test_a_restored_buffer_draws_the_same_batches(tmp_path: Path, make_chunk: MakeChunk, chunks: int) -> None:
    buffer, restored = new_buffer(), new_buffer()
    for _ in range(chunks):
        add(buffer, make_chunk(10))
    save(buffer, tmp_path / "replay", note="kept")
    state, used = read_snapshot(tmp_path / "replay", restored)
    assert state["note"] == "kept"
    assert used == tmp_path / "replay"
    assert_equal(buffer, restored)
    add(buffer, chunk := make_chunk(10))
    add(restored, chunk)
    assert_equal(buffer, restored)


@pytest.mark.parametrize("before", [1, 10, 60])
@pytest.mark.parametrize("during", [1, 10, 60])
def test_what_is_added_while_the_thread_writes_is_whole_in_the_file(
    tmp_path: Path, make_chunk: MakeChunk, before: int, during: int
) -> None:
    buffer, restored = new_buffer(), new_buffer()
    for _ in range(before):
        add(buffer, make_chunk(10))
    writer = SnapshotWriter(buffer, tmp_path / "replay")
    for _ in range(during):
        add(buffer, make_chunk(10))
    buffer.update(np.array([buffer.counters.next_item - 1]), np.array([9.0], np.float32))
    assert writer.advance(state_of(buffer), wait=True)
    read_snapshot(tmp_path / "replay", restored)
    assert_equal(buffer, restored)


def test_the_one_before_is_used_when_the_newest_is_damaged(tmp_path: Path, make_chunk: MakeChunk) -> None:
    buffer, restored = new_buffer(), new_buffer()
    path = tmp_path / "replay"
    add(buffer, make_chunk(10))
    save(buffer, path)
    add(buffer, make_chunk(10))
    save(buffer, path)
    path.write_bytes(path.read_bytes()[:-100])
    assert read_snapshot(path, restored)[1] == previous_of(path)
    assert len(restored) == 10


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_refused_wherever_the_damage_is(
    tmp_path: Path, make_chunk: MakeChunk, data: st.DataObject
) -> None:
    path = tmp_path / "replay"
    if not path.exists():
        buffer = new_buffer()
        add(buffer, make_chunk(10))
        save(buffer, path)
    whole = path.read_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    torn = whole[:place] if data.draw(st.booleans()) else bytearray(whole)
    if isinstance(torn, bytearray):
        torn[place] ^= data.draw(st.integers(1, 255))
    damaged = tmp_path / "damaged"
    damaged.write_bytes(torn)
    restored = new_buffer()
    with pytest.raises(SnapshotError):
        read_snapshot(damaged, restored)
    assert len(restored) == 0


def test_a_full_disk_costs_the_new_one_and_never_the_old(
    tmp_path: Path, make_chunk: MakeChunk, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer, restored = new_buffer(), new_buffer()
    path = tmp_path / "replay"
    add(buffer, make_chunk(10))
    save(buffer, path)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(buffer, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["replay"]
    read_snapshot(path, restored)


def test_a_snapshot_of_other_settings_is_refused_by_name(tmp_path: Path, make_chunk: MakeChunk) -> None:
    buffer = new_buffer()
    add(buffer, make_chunk(10))
    save(buffer, tmp_path / "replay")
    with pytest.raises(SnapshotError, match="capacity 200, the settings now give 100"):
        read_snapshot(tmp_path / "replay", new_buffer(100))


def test_an_abandoned_snapshot_leaves_nothing(tmp_path: Path, make_chunk: MakeChunk) -> None:
    buffer = new_buffer()
    add(buffer, make_chunk(10))
    SnapshotWriter(buffer, tmp_path / "replay").abandon()
    assert list(tmp_path.iterdir()) == []


def test_no_snapshot_is_no_restart_from_nothing_in_silence(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no snapshot"):
        read_snapshot(tmp_path / "replay", new_buffer())


def forged(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Rewrites the header of a snapshot, with a right checksum."""
    data = path.read_bytes()
    magic, version, _, offset, length = snapshot.PREFIX.unpack_from(data)
    header = json.loads(data[offset : offset + length])
    change(header)
    text = json.dumps(header).encode()
    prefix = snapshot.PREFIX.pack(magic, version, zlib.crc32(text), offset, len(text))
    path.write_bytes(prefix + data[snapshot.PREFIX.size : offset] + text)


@pytest.mark.parametrize(
    "change",
    [
        lambda header: header["state"].update(alpha="x"),
        lambda header: header["state"].update(alpha=7.0),
        lambda header: header["state"].update(buffer=[0, 10**12, 0]),
        lambda header: header["state"].update(buffer=[0, 10, "many"]),
        lambda header: header["sections"][0].update(bytes=2**40),
    ],
    ids=["alpha is text", "alpha beyond 1", "a million million items", "counters are text", "a section of a terabyte"],
)
def test_a_forged_header_is_refused_and_the_file_before_is_used(
    change: Callable[[dict[str, Any]], None], tmp_path: Path, make_chunk: MakeChunk
) -> None:
    path, buffer, restored = tmp_path / "replay", new_buffer(), new_buffer()
    add(buffer, make_chunk(10))
    save(buffer, path)
    save(buffer, path)
    forged(path, change)
    assert read_snapshot(path, restored)[1] == previous_of(path)
    assert len(restored) == 10


@pytest.mark.parametrize("is_damaged", [False, True], ids=["the newest is whole", "the newest is damaged"])
@pytest.mark.parametrize("renames_done", [0, 1])
def test_a_kill_before_each_rename_leaves_a_sound_snapshot(
    renames_done: int, is_damaged: bool, tmp_path: Path, make_chunk: MakeChunk, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, buffer, restored = tmp_path / "replay", new_buffer(), new_buffer()
    for _ in range(2):
        add(buffer, make_chunk(10))
        save(buffer, path)
    if is_damaged:
        path.write_bytes(path.read_bytes()[:-100])
    add(buffer, make_chunk(10))
    kill_before_rename(monkeypatch, renames_done)
    with pytest.raises(OSError, match="killed"):
        save(buffer, path)
    monkeypatch.undo()
    monkeypatch.setattr(snapshot, "SLICE_ROWS", 64)
    _, used = read_snapshot(path, restored)
    assert len(restored) == {(0, False): 20, (0, True): 10, (1, False): 30, (1, True): 30}[renames_done, is_damaged]
    facts = verify(path)
    assert facts is not None
    assert facts.path == used, "what is said to be restored is what is restored"
    assert facts.transitions == len(restored)
    save(restored, path)
    assert read_snapshot(path, new_buffer())[1] == path, "the run goes on from there"


def kill_before_rename(monkeypatch: pytest.MonkeyPatch, renames_left: int) -> None:
    """Ends the writing before one of its renames; nothing is removed after it, as by a process that is no more."""
    rename = Path.replace

    def replace(self: Path, target: Path) -> Path:
        nonlocal renames_left
        if renames_left == 0:
            raise OSError("killed")
        renames_left -= 1
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)


def test_a_first_snapshot_that_was_cut_off_is_none(tmp_path: Path) -> None:
    (tmp_path / "replay.writing").write_bytes(b"half")
    with pytest.raises(FileNotFoundError, match="no snapshot"):
        read_snapshot(tmp_path / "replay", new_buffer())


def test_one_that_was_cut_off_while_no_newest_stands_gives_way_to_the_one_before(
    tmp_path: Path, make_chunk: MakeChunk
) -> None:
    buffer, restored = new_buffer(), new_buffer()
    add(buffer, make_chunk(10))
    save(buffer, tmp_path / "replay")
    (tmp_path / "replay").replace(previous_of(tmp_path / "replay"))
    (tmp_path / "replay.writing").write_bytes(b"half")
    assert read_snapshot(tmp_path / "replay", restored)[1] == previous_of(tmp_path / "replay")
