"""Writes the replay to a file while it is in use, and reads it back.

Rows never change once written, so a thread copies them to the file while inserts go on, and then once or twice more
those slices in which rows were overwritten meanwhile. When it is through, `advance`, called by the owner of the buffer,
copies what is left at one moment: the items, and the few slices that changed since. That moment is the snapshot; it is
the only time in which the owner is held up.

The file: a prefix, the sections one after the other, and a JSON header at the end that names each section's place, type
and CRC-32. It is written beside, synced and renamed; the one before stays as `<name>.previous`. At every moment a whole
one can be found, see `candidates`. Nothing is pickled.
"""

from __future__ import annotations

import json
import logging
import os
import struct
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.replay.buffer import BufferCounters, ReplayBuffer
from apex_bat.storage import sync_folder

logger = logging.getLogger(__name__)

MAGIC = b"ABREPLAY"
VERSION = 1
PREFIX = struct.Struct("<8sIIQQ")  # magic, version, CRC-32 of the header, its offset, its size
SLICE_ROWS = 1 << 14  # rows of a section: 3 MB of frames
_LIES = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError)
"""What a header raises that is sound by its checksum and says what cannot be."""
WRITING = ".writing"
PASSES = 3  # over the rows; each is shorter than the one before


class SnapshotError(RuntimeError):
    """A snapshot that cannot be used; the message says which and why."""


class _Section(NamedTuple):
    """A piece of one of the buffer's arrays."""

    name: str
    first: int
    data: NDArray[Any]


class SnapshotWriter:
    """One snapshot in the making. Call `advance` until it returns True.

    Args:
        buffer: is read by a thread until then, and may be used as ever.
        path: the file to replace.
    """

    def __init__(self, buffer: ReplayBuffer, path: Path) -> None:
        self._buffer = buffer
        self._path = path
        self._beside = writing_of(path)
        self._row_begun = 0  # rows from this one on have changed since they were written to the file
        self._rows_written = threading.Event()
        self._final_given = threading.Event()
        self._final: list[_Section] = []
        self._state: dict[str, Any] = {}
        self._abandoned = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="replay-snapshot", daemon=True)
        self._thread.start()

    def advance(self, state: Callable[[], dict[str, Any]], wait: bool = False) -> bool:
        """Does the owner's part when its time has come; returns whether the snapshot is on disk.

        Args:
            state: returns what to keep beside the buffer, JSON values; called once, at the snapshot's moment.
            wait: whether to stay here until it is written.

        Raises:
            OSError: it could not be written, for example because the disk is full; the one before is untouched.
        """
        if wait:
            self._rows_written.wait()
        if self._rows_written.is_set() and not self._final_given.is_set():
            self._final = self._last_sections()
            self._state = state()
            self._final_given.set()
        if wait:
            self._thread.join()
        if self._thread.is_alive():
            return False
        if self._error is not None:
            raise self._error
        return True

    def abandon(self) -> None:
        """Ends the thread and removes what it wrote."""
        self._abandoned = True
        self._final_given.set()
        self._thread.join()

    def _last_sections(self) -> list[_Section]:
        """Copies the items, and the slices of rows that were written since the thread began."""
        sections = [_Section(name, 0, array.copy()) for name, array in self._buffer.item_arrays().items()]
        for first in self._changed_slices(self._buffer.counters.next_row):
            for name, array in self._buffer.row_arrays().items():
                sections.append(_Section(name, first, array[first : first + SLICE_ROWS].copy()))
        return sections

    def _changed_slices(self, next_row: int) -> list[int]:
        """Returns the first places of the slices in which rows from `_row_begun` up to `next_row` stand."""
        num_rows = self._buffer.num_rows
        changed = np.arange(max(self._row_begun, next_row - num_rows), next_row)
        return [int(index) * SLICE_ROWS for index in np.unique(changed % num_rows // SLICE_ROWS)]

    def _run(self) -> None:
        try:
            with self._beside.open("wb") as file:
                entries: dict[tuple[str, int], dict[str, Any]] = {}
                file.write(bytes(PREFIX.size))
                for _ in range(PASSES):
                    next_row = self._buffer.counters.next_row  # before the pass: what comes during it is left for later
                    for first in self._changed_slices(next_row):
                        for name, array in self._buffer.row_arrays().items():
                            _write(file, _Section(name, first, array[first : first + SLICE_ROWS]), entries)
                    self._row_begun = next_row
                self._rows_written.set()
                self._final_given.wait()
                if self._abandoned:
                    raise OSError("given up")
                for section in self._final:
                    _write(file, section, entries)
                _finish(file, {"fits": _shape_of(self._buffer), "state": self._state, "sections": [*entries.values()]})
            _replace(self._beside, self._path)
        except Exception as error:  # handed to the owner, who raises it in `advance`
            self._error = error
            self._beside.unlink(missing_ok=True)
        finally:
            self._rows_written.set()


def read_snapshot(path: Path, buffer: ReplayBuffer) -> tuple[dict[str, Any], Path]:
    """Fills a buffer, whose content is lost, from a snapshot, or from the one before if the newest is damaged.

    Returns:
        The state that was kept beside, and the file that was used.

    Raises:
        FileNotFoundError: there is none.
        SnapshotError: none is sound, or it was made with other settings.
    """
    files = candidates(path)
    if not files:
        raise FileNotFoundError(f"{path}: no snapshot of the replay")
    reasons = []
    for file in files:
        try:
            return _read(file, buffer), file
        except (OSError, SnapshotError) as error:
            reason = str(error)
        except _LIES as error:
            reason = f"{file}: its content contradicts itself: {error!r}"
        buffer.restore(BufferCounters(0, 0, 0))
        reasons.append(reason)
        logger.warning("snapshot not used: %s", reason)
    raise SnapshotError("; ".join(reasons))


def read_header(file: BinaryIO, path: Path) -> dict[str, Any]:
    """Returns the header of an open snapshot, its checksum compared.

    Raises:
        SnapshotError: the file is no snapshot, of another version, cut short or damaged.
        ValueError: the header is not JSON.
    """
    prefix = file.read(PREFIX.size)
    if len(prefix) < PREFIX.size or not prefix.startswith(MAGIC):
        raise SnapshotError(f"{path}: not a snapshot of the replay")
    _, version, header_crc, offset, length = PREFIX.unpack(prefix)
    if version != VERSION:
        raise SnapshotError(f"{path}: version {version}; this program reads {VERSION}")
    if offset + length > path.stat().st_size:
        raise SnapshotError(f"{path}: cut short")
    file.seek(offset)
    text = file.read(length)
    if zlib.crc32(text) != header_crc:
        raise SnapshotError(f"{path}: its header is damaged")
    header: dict[str, Any] = json.loads(text)
    return header


def candidates(path: Path) -> list[Path]:
    """Returns the files that may hold a whole snapshot, the newest first.

    Between its two renames, which a kill can part, there is no file under the name itself: the new one is whole and
    synced by then, and still under the name in which it was written.
    """
    previous, writing = previous_of(path), writing_of(path)
    is_parted = previous.exists() and not path.exists()
    return [file for file in (path, *([writing] if is_parted else []), previous) if file.exists()]


def previous_of(path: Path) -> Path:
    """Returns where the snapshot before the newest lies."""
    return path.with_name(path.name + ".previous")


def writing_of(path: Path) -> Path:
    """Returns where a snapshot is written before it takes its name."""
    return path.with_name(path.name + WRITING)


def _shape_of(buffer: ReplayBuffer) -> dict[str, int]:
    return {"capacity": buffer.capacity, "num_rows": buffer.num_rows, "memory_steps": buffer.memory_steps}


def _write(file: Any, section: _Section, entries: dict[tuple[str, int], dict[str, Any]]) -> None:
    """Writes a section, in the place of the same one if that is there already, and notes it."""
    key = (section.name, section.first)
    offset = entries[key]["offset"] if key in entries else file.seek(0, os.SEEK_END)
    file.seek(offset)
    data = np.ascontiguousarray(section.data).reshape(-1).view(np.uint8).data
    file.write(data)
    entries[key] = {
        "name": section.name,
        "first": section.first,
        "length": len(section.data),
        "offset": offset,
        "bytes": len(data),
        "crc32": zlib.crc32(data),
    }


def _finish(file: Any, header: dict[str, Any]) -> None:
    offset = file.seek(0, os.SEEK_END)
    text = json.dumps(header).encode()
    file.write(text)
    file.seek(0)
    file.write(PREFIX.pack(MAGIC, VERSION, zlib.crc32(text), offset, len(text)))
    file.flush()
    os.fsync(file.fileno())


def _replace(beside: Path, path: Path) -> None:
    if path.exists():
        path.replace(previous_of(path))
    beside.replace(path)
    sync_folder(path.parent)  # the renaming itself lasts only then


def _read(path: Path, buffer: ReplayBuffer) -> dict[str, Any]:
    with path.open("rb") as file:
        header = read_header(file, path)
        wanted = _shape_of(buffer)
        for name, value in header["fits"].items():
            if value != wanted.get(name):
                raise SnapshotError(f"{path}: was made with {name} {value}, the settings now give {wanted.get(name)}")
        arrays = buffer.row_arrays() | buffer.item_arrays()
        for entry in header["sections"]:
            _read_section(file, path, entry, arrays)
    state: dict[str, Any] = header["state"]
    alpha, counters = float(state["alpha"]), BufferCounters(*map(int, state["buffer"]))
    if not 0.0 <= alpha <= 1.0:
        raise SnapshotError(f"{path}: alpha {alpha} is not between 0 and 1")
    buffer.alpha = alpha
    buffer.restore(counters)
    return state


def _read_section(file: Any, path: Path, entry: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    target = arrays[entry["name"]][entry["first"] : entry["first"] + entry["length"]]
    if target.nbytes != entry["bytes"]:
        raise SnapshotError(f"{path}: section {entry['name']} has another size")
    file.seek(entry["offset"])
    data = file.read(entry["bytes"])
    if zlib.crc32(data) != entry["crc32"]:
        raise SnapshotError(f"{path}: section {entry['name']} is damaged")
    target.reshape(-1).view(np.uint8)[:] = np.frombuffer(data, np.uint8)
