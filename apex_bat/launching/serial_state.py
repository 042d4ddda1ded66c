"""The saved states of a serial run: everything at one moment as one folder, whole or absent.

`serial/turn-N/` holds `state.npz` (roles, weights, counters, how long each file of metrics was), `replay.snapshot`, the
newest regular checkpoint and the best one. It is written beside, synced and renamed; the two newest are kept. A second
state of the same turn is `turn-N.2`, so that none ever gives way to one that is not there yet. Every file is
checksummed. Nothing is pickled.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from apex_bat.replay.snapshot import SnapshotError, SnapshotWriter, read_snapshot
from apex_bat.replay.store import ReplayStore
from apex_bat.roles import checkpoint
from apex_bat.storage import State, StorageError, beside_of, read_arrays, sync_folder, write_arrays

FOLDER = "serial"
KIND = "apex_bat serial state 1"
NUM_KEPT = 2
_STATE, _REPLAY, _BEST = "state.npz", "replay.snapshot", (checkpoint.BEST,)
_NAME = re.compile(r"turn-(\d{12})(?:\.(\d+))?")
_log = logging.getLogger(__name__)


class SavedRun(NamedTuple):
    """A saved state that was read back, its arrays checked; the replay is read when it is filled."""

    folder: Path
    state: State
    """What the roles, the weights and the run itself continue from."""
    metrics_bytes: Mapping[str, int]
    """Length of each file below `metrics/` at that moment."""
    checkpoints: tuple[str, ...]
    """Names of the numbered checkpoints that there were."""

    @property
    def replay(self) -> Path:
        """The replay's snapshot."""
        return self.folder / _REPLAY


def write(run: Path, turn: int, state: State, store: ReplayStore) -> Path:
    """Writes a state and removes all but the two newest; returns its folder.

    Args:
        run: the run folder; nothing in it may change meanwhile.
        turn: number of the moment.
        state: of everything but the replay.
        store: the replay.

    Raises:
        StorageError: it could not be written; those before are untouched.
    """
    folder = run / FOLDER / f"turn-{turn:012d}"
    twins = [path for path in find(run) if _moment_of(path)[0] == turn]  # broken off at another point, or torn
    if twins:
        folder = folder.with_name(f"{folder.name}.{_moment_of(twins[-1])[1] + 1}")
    beside = beside_of(folder)
    try:
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir(parents=True)
        numbered = checkpoint.find(run / "checkpoints")
        kept = [*numbered[-1:], *(run / "checkpoints" / name for name in _BEST)]
        for path in kept:
            if path.exists():
                _copy(path, beside / path.name)
        header = {
            "values": state.values,
            "metrics_bytes": _lengths(run / "metrics"),
            "checkpoints": [path.name for path in numbered],
        }
        SnapshotWriter(store.buffer, beside / _REPLAY).advance(store.state, wait=True)
        write_arrays(beside / _STATE, KIND, header, state.arrays)
        sync_folder(beside)
        beside.replace(folder)
        sync_folder(folder.parent)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    for old in (*[path for path in find(run) if path not in twins][:-NUM_KEPT], *twins):
        shutil.rmtree(old, ignore_errors=True)
    return folder


def find(run: Path) -> list[Path]:
    """Returns the folders of the saved states, oldest first."""
    return sorted((path for path in (run / FOLDER).glob("turn-*") if _NAME.fullmatch(path.name)), key=_moment_of)


def read_newest(run: Path, store: ReplayStore) -> SavedRun | None:
    """Returns the newest sound state and fills the replay from it, saying in the log which are torn; None without any.

    Raises:
        StorageError: there are states, and none of them is sound.
    """
    reasons: list[str] = []
    for folder in reversed(find(run)):
        try:
            found = _read(folder, store)
        except (StorageError, SnapshotError, OSError, KeyError) as error:
            reasons.append(str(error))
            continue
        for reason in reasons:
            _log.warning("%s; an older state is used", reason)
        return found
    if reasons:
        number = len(reasons)
        raise StorageError(f"{run / FOLDER}: none of the {number} saved states is sound; the newest: {reasons[0]}")
    return None


def put_back(run: Path, saved: SavedRun) -> None:
    """Makes checkpoints and metrics what they were at the saved moment: what came later will come again.

    Raises:
        StorageError: a file of metrics is shorter than it was then.
    """
    folder, metrics = run / "checkpoints", run / "metrics"
    short = [
        name
        for name, length in saved.metrics_bytes.items()
        if not (metrics / name).is_file() or (metrics / name).stat().st_size < length
    ]
    if short:
        raise StorageError(f"{metrics / short[0]}: shorter than when the state was saved; it was changed since")
    for path in checkpoint.find(folder):
        if path.name not in saved.checkpoints:
            path.unlink()
    for name in _BEST:
        (folder / name).unlink(missing_ok=True)
    for path in (*checkpoint.find(saved.folder), *(saved.folder / name for name in _BEST)):
        if path.exists():
            _copy(path, folder / path.name)
    for name in _lengths(metrics):
        if name in saved.metrics_bytes:
            os.truncate(metrics / name, saved.metrics_bytes[name])
        else:
            (metrics / name).unlink()


def _read(folder: Path, store: ReplayStore) -> SavedRun:
    header, arrays = read_arrays(folder / _STATE, KIND)
    for path in checkpoint.find(folder):
        checkpoint.load(path)
    if (folder / checkpoint.BEST).exists():
        checkpoint.load(folder / checkpoint.BEST)
    state, _ = read_snapshot(folder / _REPLAY, store.buffer)
    store.restore(state)
    return SavedRun(folder, State(header["values"], arrays), header["metrics_bytes"], tuple(header["checkpoints"]))


def _moment_of(folder: Path) -> tuple[int, int]:
    """Returns the turn of a state and which of that turn's states it is, from 1, by its name."""
    match = _NAME.fullmatch(folder.name)
    if match is None:
        raise ValueError(f"{folder.name} is not the name of a saved state")
    return int(match[1]), int(match[2] or 1)


def _lengths(folder: Path) -> dict[str, int]:
    """Returns the length of each file below a folder, after it reached the disk, by its relative path."""
    lengths = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            os.fsync(file.fileno())
        lengths[path.relative_to(folder).as_posix()] = path.stat().st_size
    return lengths


def _copy(source: Path, target: Path) -> None:
    """Copies a file beside its target and renames it."""
    beside = beside_of(target)
    shutil.copyfile(source, beside)
    with beside.open("rb+") as file:
        os.fsync(file.fileno())
    beside.replace(target)
