"""Files of arrays with a header: checkpoints and snapshots. Written beside, synced and renamed; checked when read.

The format is numpy's .npz without compression and without pickle; the header is JSON in an array of its own. The zip
container carries a CRC-32 of each array, which numpy checks on reading, so a torn or rotten file is refused.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

MAX_JSON_BYTES = 1 << 26  # of run.json, status.json and the like, which have some kilobytes
MAX_UNPACKED_BYTES = 1 << 30  # of a compressed file of arrays: one kilobyte of it could claim a megabyte
MAX_NPY_HEADER = 10_000  # characters, as numpy has it
PLAIN_KINDS = "biufSU"  # booleans, numbers, text: no objects, which would be pickled, and no records
UNFINISHED = ".part"  # end of the name of what is written beside; the name begins with a dot
_HEADER, _DATA = "header.json", "data/"
_NPZ_ERRORS = (
    OSError, ValueError, KeyError, TypeError, EOFError, OverflowError, RecursionError, RuntimeError, MemoryError,
    SyntaxError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error, NotImplementedError,
)  # fmt: skip  # all that zipfile and numpy raise for files that are none of theirs


class StorageError(ValueError):
    """A file that is missing, torn, corrupted, of another kind, or cannot be written."""


class State(NamedTuple):
    """What something continues from, in the form in which `write_arrays` keeps it."""

    values: dict[str, Any]
    """What JSON can hold; numbers come back as they were, to the bit."""
    arrays: dict[str, NDArray[Any]]


class Continuing(Protocol):
    """Anything that can be saved and continued."""

    def state(self) -> State:
        """Returns all that it continues from."""

    def restore(self, state: State) -> object:
        """Continues from what `state` returned."""


def joined(parts: Mapping[str, State]) -> State:
    """Returns one state that holds several, each under its name, which has no "/"."""
    arrays = {f"{name}/{key}": array for name, part in parts.items() for key, array in part.arrays.items()}
    return State({name: part.values for name, part in parts.items()}, arrays)


def part_of(state: State, name: str) -> State:
    """Returns one of the states that `joined` took."""
    prefix = f"{name}/"
    arrays = {key.removeprefix(prefix): array for key, array in state.arrays.items() if key.startswith(prefix)}
    return State(state.values[name], arrays)


def digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Returns the SHA-256 of names, types, shapes and bytes of arrays, in hexadecimal digits."""
    total = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        total.update(f"{name} {array.dtype} {array.shape}\n".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def write_arrays(path: Path, kind: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Writes arrays and a header so that at `path` stands the old file or the whole new one, never a part.

    Args:
        path: where; its folder must exist.
        kind: what the file is, for example "checkpoint"; `read_arrays` asks for the same.
        header: what JSON can hold.
        arrays: by name; names may hold "/".

    Raises:
        StorageError: the disk is full or the folder cannot be written; the old file is untouched.
    """
    text = json.dumps({"kind": kind, **header}, sort_keys=True)
    content = {_HEADER: np.frombuffer(text.encode(), np.uint8)} | {_DATA + name: a for name, a in arrays.items()}
    beside = beside_of(path)
    try:
        with beside.open("wb") as file:
            np.savez(file, allow_pickle=False, **content)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        beside.unlink(missing_ok=True)


def read_arrays(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Returns header and arrays of a file written by `write_arrays`, every byte checked.

    Raises:
        StorageError: names the file and what is wrong with it.
    """
    content = read_npz(path, is_packed=False)
    try:
        header = json.loads(content.pop(_HEADER).tobytes())
    except (KeyError, ValueError, RecursionError) as error:
        raise StorageError(f"{path}: torn or corrupted: {error!r}") from None
    if not isinstance(header, dict) or header.get("kind") != kind:
        raise StorageError(f"{path}: not a {kind}")
    return header, {name.removeprefix(_DATA): array for name, array in content.items()}


def read_npz(path: Path, *, is_packed: bool = True, max_bytes: int = MAX_UNPACKED_BYTES) -> dict[str, NDArray[Any]]:
    """Returns the arrays of an .npz file, every byte checked, without taking more memory than there is to read.

    `numpy.load` makes an array of the size that a header claims before it has looked at the data, and unpacks whatever
    there is; here both are known before.

    Args:
        path: the file.
        is_packed: whether it may be compressed; otherwise its size bounds that of its arrays.
        max_bytes: of all arrays, where it may be compressed.

    Raises:
        StorageError: names the file and what is wrong with it.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            limit = max_bytes if is_packed else path.stat().st_size
            if len({member.filename for member in members}) < len(members):
                raise ValueError("two arrays have one name")
            if any(member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for member in members):
                raise ValueError("packed in a way that is not read here")
            if sum(member.file_size for member in members) > limit:
                raise ValueError(f"its arrays claim more than {limit} bytes")
            return {member.filename.removesuffix(".npy"): _read_array(archive, member) for member in members}
    except FileNotFoundError:
        raise StorageError(f"{path}: no such file") from None
    except _NPZ_ERRORS as error:
        raise StorageError(f"{path}: torn or corrupted: {str(error) or repr(error)}") from None


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> dict[str, Any]:
    """Returns the object in a JSON file.

    Raises:
        StorageError: the file is missing, larger than allowed, or holds no JSON object.
    """
    try:
        with path.open("rb") as file:
            text = file.read(max_bytes + 1)
        if len(text) > max_bytes:
            raise ValueError(f"larger than {max_bytes} bytes")
        content = json.loads(text)
    except FileNotFoundError:
        raise StorageError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise StorageError(f"{path}: torn or corrupted: {error}") from None
    if not isinstance(content, dict):
        raise StorageError(f"{path}: holds no JSON object")
    return content


def write_text(path: Path, text: str, mode: int = 0o666) -> None:
    """Writes a small text file in the same way: the old one or the whole new one.

    Args:
        path: where; its folder must exist.
        text: what.
        mode: permissions of the file, less what the umask takes.

    Raises:
        StorageError: it cannot be written.
    """
    beside = beside_of(path)
    try:
        descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        beside.unlink(missing_ok=True)


def beside_of(path: Path) -> Path:
    """Returns where this process writes a file or folder before it takes its name."""
    return path.with_name(f".{path.name}.{os.getpid()}{UNFINISHED}")


def writer_of(path: Path) -> int | None:
    """Returns the process that a file which `beside_of` named was written by; None if the name does not tell."""
    number = path.name.removesuffix(UNFINISHED).rpartition(".")[2]
    return int(number) if number.isdecimal() else None


def sync_folder(folder: Path) -> None:
    """Makes a rename in a folder durable, on systems where a folder can be synced."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Returns one array; its bytes are read, and their CRC-32 checked, before an array is made of them."""
    with archive.open(member) as file:
        version = npy.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"array format {version}")
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, is_fortran, dtype = read_header(file, max_header_size=MAX_NPY_HEADER)
        if dtype.kind not in PLAIN_KINDS:
            raise ValueError(f"an array of {dtype}, where numbers and text are allowed")
        data = bytearray(file.read(member.file_size))
    if any(length < 0 for length in shape) or dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of {dtype} {shape} in {len(data)} bytes")
    array = np.frombuffer(data, dtype) if data else np.zeros(math.prod(shape), dtype)
    return array.reshape(shape, order="F" if is_fortran else "C")
