"""Files of arrays with a header: checkpoints and snapshots. Written beside, synced and renamed; checked when read.

The format is numpy's .npz without compression and without pickle; the header is JSON in an array of its own. The zip
container carries a CRC-32 of each array, which numpy checks on reading, so a torn or rotten file is refused.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEADER, _DATA = "header.json", "data/"


class StorageError(ValueError):
    """A file that is missing, torn, corrupted, of another kind, or cannot be written."""


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
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
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
    try:
        with np.load(path, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
        header = json.loads(content.pop(_HEADER).tobytes())
    except FileNotFoundError:
        raise StorageError(f"{path}: no such file") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise StorageError(f"{path}: torn or corrupted: {error}") from None
    if not isinstance(header, dict) or header.get("kind") != kind:
        raise StorageError(f"{path}: not a {kind}")
    return header, {name.removeprefix(_DATA): array for name, array in content.items()}


def write_text(path: Path, text: str) -> None:
    """Writes a small text file in the same way: the old one or the whole new one.

    Raises:
        StorageError: it cannot be written.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with beside.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        beside.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Makes a rename in a folder durable, on systems where a folder can be synced."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
