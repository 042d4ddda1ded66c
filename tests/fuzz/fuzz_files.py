"""Fuzzes every loader of files: what it reads is right, or its own documented error is raised.

By hand, guided by coverage: `python -m tests.fuzz.fuzz_files [libFuzzer's options] [corpus folders]`, which wants
atheris (the extra `fuzz`). The quick suite calls the same targets with what hypothesis makes up and with the corpus.

The first byte of an input chooses the loader, the rest is the file. Recordings are fuzzed apart, in `fuzz_recordings`:
their decoder is not ours, and ends the whole process when it meets some kinds of damage.
"""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from apex_bat import config as configuration
from apex_bat.config import Config, ConfigError
from apex_bat.evaluation.runs import note, training_facts
from apex_bat.launching.status import STATUS, figures, read_status
from apex_bat.recording.training import rows_of
from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.snapshot import MAGIC, PREFIX, VERSION, SnapshotError, SnapshotWriter, read_snapshot
from apex_bat.roles import checkpoint
from apex_bat.roles.plan import Addresses, read_addresses
from apex_bat.simulation import arenas
from apex_bat.simulation.layout import ArenaError
from apex_bat.storage import StorageError, read_arrays, read_npz, write_arrays
from apex_bat.transport.security import TransportError, load_keys, make_keys
from tests.fuzz.fuzz_messages import chunk
from tests.fuzz.guided import run

_CONFIG = b"""seed = 3
arena = "simple"
[replay]
capacity = 50000
[transport]
host = "ipc"
[train]
max_minutes = "none"
max_updates = 5
"""


class Target(NamedTuple):
    """A loader, what it may raise, and a file that it reads."""

    read: Callable[[bytes], object]
    error: type[Exception]
    seed: bytes


def fuzz(data: bytes) -> None:
    """Gives the rest of some bytes to the loader that the first one chooses."""
    names = sorted(targets())
    if data:
        take(names[data[0] % len(names)], data[1:])


def take(name: str, content: bytes) -> None:
    """Lets a loader read a content; nothing but its documented error may be raised."""
    target = targets()[name]
    try:
        target.read(content)
    except target.error as error:
        assert str(error)  # noqa: PT017  # that it is raised at all is no fault


@cache
def targets() -> dict[str, Target]:
    """Returns all loaders by name."""
    folder = _folder()
    keys = folder / "keys"
    make_keys(keys)
    return {
        "addresses": _of_file(
            read_addresses, StorageError, msgspec.json.encode(Addresses("a", "b", "c", replay_generation=3))
        ),
        "arena": Target(_arena, ArenaError, (arenas.arena_folder() / "simple.toml").read_bytes()),
        "arrays": _of_file(lambda path: read_arrays(path, "thing"), StorageError, _npz("thing")),
        "best": Target(_best, StorageError, b'{"score": [0.5, 12.0], "checkpoint": "step-000000001.npz"}'),
        "checkpoint": _of_file(checkpoint.load, StorageError, _npz(checkpoint.KIND)),
        "config": _of_file(configuration.load, ConfigError, _CONFIG),
        "keys": Target(_keys, TransportError, (keys / "client.public").read_bytes()),
        "member": Target(_member, StorageError, _npy(np.arange(6.0).reshape(2, 3))),
        "metrics": Target(_metrics, StorageError, b'{"role": "replay", "unix_s": 1.5}\n{"role": "replay"}\n'),
        "override": Target(_override, ConfigError, b"replay.capacity=50000"),
        "packed": _of_file(lambda path: read_npz(path, max_bytes=10_000), StorageError, _packed()),
        "run": Target(
            _run, StorageError, b'{"start": "2026-01-01T00:00:00+00:00", "end": "2026-01-01T00:00:01+00:00"}'
        ),
        "snapshot": Target(_snapshot, SnapshotError, _snapshot_seed()),
        "snapshot_header": Target(_snapshot_header, SnapshotError, _header_of(_snapshot_seed())),
        "status": Target(_status, StorageError, _status_seed()),
    }


@cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="apex_bat-fuzz-")  # removed when the process ends


@cache
def _folder() -> Path:
    folder = Path(_temporary().name)
    for name in ("metrics", "keys", "checkpoints"):
        (folder / name).mkdir()
    (folder / "checkpoints" / "one").write_bytes(b"")
    return folder


def _of_file(load: Callable[[Path], object], error: type[Exception], seed: bytes) -> Target:
    def read(content: bytes) -> object:
        return load(_file(content))

    return Target(read, error, seed)


def _file(content: bytes, name: str = "file") -> Path:
    path = _folder() / name
    path.write_bytes(content)
    return path


def _arena(content: bytes) -> object:
    return arenas._read.__wrapped__(_file(content))  # not the cached one: the file changes


def _best(content: bytes) -> object:
    _file(content, f"checkpoints/{checkpoint.BEST}")
    return checkpoint.mark_best(_folder() / "checkpoints", checkpoint.Checkpoint(1, {}, {}, {}), (0.25, 1.0))


def _keys(content: bytes) -> object:
    path = _file(content, "keys/client.public")
    path.chmod(0o600)
    return load_keys(path.parent)


def _member(content: bytes) -> object:
    """An archive that is whole, with an array in it that may not be."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("data/a.npy", content)
    return read_npz(_file(archive.getvalue()), is_packed=False)


def _metrics(content: bytes) -> object:
    _file(content, "metrics/replay.jsonl")
    return list(rows_of(_folder()))


def _override(content: bytes) -> object:
    return configuration.load(None, [content.decode("utf-8", "replace")])


def _run(content: bytes) -> object:
    _file(content, "run.json")
    facts = training_facts(_folder(), Config())
    note(_folder(), outcome="failed")
    return facts


def _snapshot(content: bytes) -> object:
    return read_snapshot(_file(content), _buffer())


def _snapshot_header(content: bytes) -> object:
    """A snapshot whose header has the right checksum, whatever it says."""
    whole = _snapshot_seed()
    offset = PREFIX.unpack_from(whole)[3]
    prefix = PREFIX.pack(MAGIC, VERSION, zlib.crc32(content), offset, len(content))
    return _snapshot(prefix + whole[PREFIX.size : offset] + content)


def _status(content: bytes) -> object:
    _file(content, STATUS)
    return [figures(row) for row in read_status(_folder())["roles"]]


def _npz(kind: str) -> bytes:
    path = _folder() / "seed.npz"
    header = {"learner_step": 3, "fingerprint": {}, "counters": {}}
    write_arrays(path, kind, header, {"online/a": np.ones((2, 2), np.float32)})
    return path.read_bytes()


def _npy(array: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def _packed() -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, a=np.zeros(100))
    return file.getvalue()


def _buffer() -> ReplayBuffer:
    return ReplayBuffer(20, 40, memory_steps=3, heard_steps=3, alpha=0.6)


@cache
def _snapshot_seed() -> bytes:
    buffer, path = _buffer(), _folder() / "seed.snapshot"
    one = chunk(4)
    buffer.add([one], one.priorities + np.float32(0.01), 2, 5)
    SnapshotWriter(buffer, path).advance(lambda: {"buffer": list(buffer.counters), "alpha": 0.6}, wait=True)
    return path.read_bytes()


def _header_of(snapshot: bytes) -> bytes:
    _, _, _, offset, length = PREFIX.unpack_from(snapshot)
    return snapshot[offset : offset + length]


def _status_seed() -> bytes:
    row = {"role": "actor-0", "state": "flying", "heartbeat_age_s": 0.5, "metrics": {"env_steps_per_s": 3.0}}
    content = {"launcher_pid": 1, "launcher_began_unix_s": 1.0, "host": "h", "written_unix_s": 1.0, "roles": [row]}
    return json.dumps(content).encode()


if __name__ == "__main__":
    run("tests.fuzz.fuzz_files")
