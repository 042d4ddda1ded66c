"""Files of arrays: whole or not at all."""

import errno
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apex_bat.storage import StorageError, read_arrays, write_arrays

ARRAYS = {"a/b": np.arange(6.0).reshape(2, 3), "file": np.array([], np.float32), "c": np.array(3)}


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    write_arrays(tmp_path / "x.npz", "thing", {"step": 3}, ARRAYS)
    header, arrays = read_arrays(tmp_path / "x.npz", "thing")
    assert header["step"] == 3
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype


def test_any_flipped_or_missing_byte_of_the_data_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    write_arrays(path, "thing", {}, {"a": np.arange(100.0)})
    whole = path.read_bytes()
    start = whole.index(np.arange(100.0).tobytes())
    for damaged in (whole[: len(whole) // 2], b"", whole[: start + 9] + b"\x01" + whole[start + 10 :]):
        path.write_bytes(damaged)
        with pytest.raises(StorageError, match="torn or corrupted"):
            read_arrays(path, "thing")


def test_a_missing_file_and_another_kind_are_named(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="no such file"):
        read_arrays(tmp_path / "x.npz", "thing")
    write_arrays(tmp_path / "x.npz", "thing", {}, {})
    with pytest.raises(StorageError, match="not a checkpoint"):
        read_arrays(tmp_path / "x.npz", "checkpoint")


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    with (tmp_path / "x.npz").open("wb") as file:
        np.savez(file, a=np.array([{}], object))
    with pytest.raises(StorageError):
        read_arrays(tmp_path / "x.npz", "thing")


def test_a_full_disk_costs_the_new_file_never_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.npz"
    write_arrays(path, "thing", {"step": 1}, ARRAYS)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(StorageError, match="No space left"):
        write_arrays(path, "thing", {"step": 2}, ARRAYS)
    monkeypatch.undo()
    assert read_arrays(path, "thing")[0]["step"] == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.npz"]
