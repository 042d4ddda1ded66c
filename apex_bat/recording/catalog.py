"""The flight recordings of a run: what each is of, and finding the best, the worst, a crash or a certain one."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apex_bat.recording.probing import undecodable
from apex_bat.recording.reading import RecordingError, read_properties
from apex_bat.recording.training import TRAINING_RECORDING

Pose = tuple[float, float, float]
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """One recording, as its properties describe it."""

    path: Path
    """The .rrd, or .rrd.part when the process that wrote it was killed."""
    kind: str
    """`training` or `evaluation`."""
    arena: str
    condition: str
    mark: str
    """best, worst, crash, or empty."""
    seed: int
    episode: int
    checkpoint_step: int | None
    """Learner step of the weights; None: unknown."""
    start: Pose | None
    """x in m, y in m, heading in rad; None in recordings of older versions."""
    steps: int
    returned: float
    """Undiscounted return."""
    progress_m: float
    end: str
    """damage, idle, contact, time, or empty."""

    @property
    def merit(self) -> tuple[bool, float]:
        """What ranks flights, as `keeping.merit`."""
        return self.end == "time", abs(self.progress_m)


def list_flights(run: Path, condition: str = "") -> list[Entry]:
    """Returns the recordings of a run: evaluations before training, newer weights first, then by arena and number.

    Files that are no flight recordings are left out.

    Args:
        run: the run folder.
        condition: only flights under this condition; empty: all.

    Raises:
        RecordingError: there are none.
    """
    folder = run / "recordings"
    paths = [path for path in (*folder.glob("*.rrd"), *folder.glob("*.rrd.part")) if path.name != TRAINING_RECORDING]
    damaged = undecodable(paths)
    for path in damaged:
        _log.warning("%s: damaged so that nothing can read it; left out", path)
    entries = [entry for path in paths if path not in damaged and (entry := _entry(path)) is not None]
    if not entries:
        raise RecordingError(f"{run}: no flight recordings; `apex-bat evaluate {run} --record 3` makes some")
    found = [entry for entry in entries if condition in ("", entry.condition)]
    if not found:
        conditions = ", ".join(sorted({entry.condition for entry in entries}))
        raise RecordingError(f"{run}: no flights under the condition {condition!r}; there are {conditions}")
    return sorted(found, key=_order)


def choose_flight(entries: Sequence[Entry], which: str) -> Entry:
    """Returns one of the entries; evaluations are preferred to training.

    Args:
        entries: at least one.
        which: `best`, `worst`, `crash` (the one that flew longest before it), or a number, from 0 in the order of the
            entries.

    Raises:
        RecordingError: there is no such flight.
    """
    if which.isdecimal():
        if int(which) >= len(entries):
            raise RecordingError(f"there is no flight {which}; the last is {len(entries) - 1}")
        return entries[int(which)]
    judged = [entry for entry in entries if entry.kind == "evaluation"] or list(entries)
    if which == "best":
        return max(judged, key=lambda entry: entry.merit)
    if which == "worst":
        return min(judged, key=lambda entry: entry.merit)
    if which == "crash":
        for group in (judged, entries):
            crashes = [entry for entry in group if entry.end in ("contact", "damage")]
            if crashes:
                return max(crashes, key=lambda entry: entry.steps)
        raise RecordingError("no recorded flight ended at a wall")
    raise RecordingError(f"flight {which!r}: best, worst, crash or a number of the list")


def same_start(entry: Entry, others: Sequence[Entry]) -> Entry:
    """Returns the newest of the other flights that began in the same arena at the same pose.

    Raises:
        RecordingError: there is none.
    """
    for other in others:
        if other.start is not None and (other.arena, other.start) == (entry.arena, entry.start):
            return other
    raise RecordingError(
        f"no recorded flight starts as {entry.path.name} does; record the same flights of both runs with"
        f" `apex-bat evaluate RUN --arenas {entry.arena} --record 3`"
    )


def _order(entry: Entry) -> tuple[bool, int, str, int, str]:
    weights = -1 if entry.checkpoint_step is None else entry.checkpoint_step
    return entry.kind != "evaluation", -weights, entry.arena, entry.episode, entry.path.name


def _entry(path: Path) -> Entry | None:
    """The entry of a file that can be decoded; None for what is no flight recording, or not yet."""
    try:
        return _described(path, read_properties(path, is_tried=True))
    except (RecordingError, KeyError, TypeError, ValueError):
        return None


def _described(path: Path, known: Mapping[str, Any]) -> Entry:
    start = [float(known[name]) for name in ("start_x_m", "start_y_m", "start_heading_rad") if name in known]
    return Entry(
        path=path,
        kind=str(known["kind"]),
        arena=str(known["arena"]),
        condition=str(known["condition"]),
        mark=str(known.get("mark", "")),
        seed=int(known["seed"]),
        episode=int(known["episode"]),
        checkpoint_step=int(known["checkpoint_step"]) if "checkpoint_step" in known else None,
        start=(start[0], start[1], start[2]) if len(start) == 3 else None,
        steps=int(known["steps"]),
        returned=float(known["return"]),
        progress_m=float(known["progress_m"]),
        end=str(known["end"]),
    )
