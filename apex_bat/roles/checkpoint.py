"""Checkpoints of the learner: what they hold, how they are named, found, kept and judged."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import policy_parameters
from apex_bat.config import Config
from apex_bat.storage import StorageError, read_arrays, write_arrays

KIND = "apex_bat checkpoint 1"
BEST = "best.npz"
CHANCE = 0.1  # share by which the progress of equally good policies differs
_NAME = re.compile(r"step-(\d{9})\.npz")
_log = logging.getLogger(__name__)


class _Header(msgspec.Struct):
    """What stands in the file beside the arrays."""

    learner_step: int
    fingerprint: dict[str, Any]
    counters: dict[str, Any]


class Checkpoint(NamedTuple):
    """A learner at one moment."""

    learner_step: int
    """Updates made."""
    fingerprint: dict[str, Any]
    """The settings that a policy depends on, see `fingerprint`."""
    counters: dict[str, Any]
    """Whatever else the learner continues from: weights version, random states."""
    arrays: dict[str, NDArray[Any]]
    """`online/...`, `target/...`, `optimiser/...`, and `average/...` where the learner averages."""

    def policy_parameters(self) -> dict[str, NDArray[np.float32]]:
        """Returns the parameters to fly with by name, see `inference.policy_parameters`."""
        return policy_parameters(self.arrays)


def fingerprint(config: Config) -> dict[str, Any]:
    """Returns the settings that a checkpoint must share with the run that loads it: network and sensing."""
    settings = (config.network, config.sensing, config.condition, config.sonar.rendering)
    names = ("network", "sensing", "condition", "rendering")
    return {name: json.loads(msgspec.json.encode(value)) for name, value in zip(names, settings, strict=True)}


def save(folder: Path, checkpoint: Checkpoint, keep: int) -> Path:
    """Writes a checkpoint as `step-N.npz` and removes all but the newest `keep`; returns its path.

    Raises:
        StorageError: it could not be written; older ones are untouched.
    """
    path = folder / f"step-{checkpoint.learner_step:09d}.npz"
    _write(path, checkpoint)
    for old in find(folder)[:-keep]:
        old.unlink(missing_ok=True)
    return path


def load(path: Path) -> Checkpoint:
    """Reads a checkpoint.

    Raises:
        StorageError: the file is missing, torn or not a checkpoint.
    """
    header, arrays = read_arrays(path, KIND)
    try:
        known = msgspec.convert(header, _Header)
    except msgspec.ValidationError as error:
        raise StorageError(f"{path}: not a checkpoint: {error}") from None
    return Checkpoint(known.learner_step, known.fingerprint, known.counters, arrays)


def load_newest(folder: Path) -> Checkpoint | None:
    """Returns the newest checkpoint that can be read, saying in the log which could not; None if there is none.

    Raises:
        StorageError: there are checkpoints, and none of them can be read.
    """
    reasons: list[str] = []
    for path in reversed(find(folder)):
        try:
            found = load(path)
        except StorageError as error:
            reasons.append(str(error))
            continue
        for reason in reasons:
            _log.warning("%s; an older one is used", reason)
        return found
    if reasons:
        raise StorageError(f"{folder}: none of the {len(reasons)} checkpoints can be read; the newest: {reasons[0]}")
    return None


def find(folder: Path) -> list[Path]:
    """Returns the paths of the numbered checkpoints, oldest first."""
    return sorted(path for path in folder.glob("step-*.npz") if _NAME.fullmatch(path.name))


def step_of(path: Path) -> int:
    """Returns the learner step in a checkpoint's name."""
    match = _NAME.fullmatch(path.name)
    if match is None:
        raise ValueError(f"{path.name} is not the name of a checkpoint")
    return int(match[1])


def mark_best(folder: Path, checkpoint: Checkpoint, score: tuple[float, float]) -> bool:
    """Keeps a checkpoint as the best unless the best so far is better; says whether.

    More completed flights are better. Where as many were completed, more progress is, if it is more by a tenth: less is
    chance, and then the newer one, which has learnt more, is kept.

    Score and checkpoint are one file, so that no kill can part them; and it is written from memory, so that it does not
    matter whether the numbered file was removed while it was judged.

    Args:
        folder: of the checkpoints.
        checkpoint: the one that was judged, newer than all before.
        score: share of completed flights, and mean progress in m.

    Raises:
        StorageError: it could not be written; the best so far is untouched.
    """
    path = folder / BEST
    so_far = _score_of(path) if path.exists() else None
    if so_far is not None:
        completed, progress_m = so_far
        if score[0] < completed or (score[0] == completed and score[1] < (1.0 - CHANCE) * progress_m):
            return False
    _write(path, checkpoint._replace(counters=checkpoint.counters | {"score": list(score)}))
    return True


def set_torn_aside(folder: Path, newest: Checkpoint) -> None:
    """Renames checkpoints beyond the newest that can be read: by their names they would stay the newest."""
    for path in find(folder):
        if step_of(path) > newest.learner_step:
            path.replace(path.with_name(path.name + ".torn"))


def _write(path: Path, checkpoint: Checkpoint) -> None:
    header = {
        "learner_step": checkpoint.learner_step,
        "fingerprint": checkpoint.fingerprint,
        "counters": checkpoint.counters,
    }
    write_arrays(path, KIND, header, checkpoint.arrays)


def _score_of(path: Path) -> tuple[float, float] | None:
    """Returns the score of the best checkpoint so far; None if it is damaged."""
    try:
        return msgspec.convert(load(path).counters.get("score"), tuple[float, float])
    except (StorageError, msgspec.ValidationError) as error:
        _log.warning("%s: not read, the next checkpoint counts as the best: %s", path, error)
        return None
