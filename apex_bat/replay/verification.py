"""Looks through a snapshot of the replay without filling a buffer: whether it is sound, what it holds, and its hash."""

from __future__ import annotations

import hashlib
import zlib
from pathlib import Path
from typing import NamedTuple

from apex_bat.replay.snapshot import SnapshotError, candidates, read_header


class SnapshotFacts(NamedTuple):
    """What a sound snapshot holds."""

    path: Path
    transitions: int
    inserted: int
    """Transitions ever inserted."""
    fits: dict[str, int]
    """The settings that it was made with."""
    sha256: str
    """Of the rows and items, in the order of their places: equal for equal replays."""
    refused: str
    """Why a newer snapshot was not taken; empty if this is the newest."""


def verify(path: Path) -> SnapshotFacts | None:
    """Returns the facts of the newest sound snapshot, or of the one before it; None if there is none at all.

    Raises:
        SnapshotError: there are snapshots, and none is sound.
    """
    reasons: list[str] = []
    for file in candidates(path):
        try:
            return _verify(file)._replace(refused="; ".join(reasons))
        except (OSError, SnapshotError) as error:
            reasons.append(str(error))
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            reasons.append(f"{file}: its content contradicts itself: {error!r}")
    if reasons:
        raise SnapshotError("; ".join(reasons))
    return None


def _verify(path: Path) -> SnapshotFacts:
    size = path.stat().st_size
    with path.open("rb") as file:
        header = read_header(file, path)
        total = hashlib.sha256()
        for entry in sorted(header["sections"], key=lambda entry: (entry["name"], entry["first"])):
            if not 0 <= entry["offset"] <= entry["offset"] + entry["bytes"] <= size:
                raise SnapshotError(f"{path}: section {entry['name']} reaches beyond the file")
            file.seek(entry["offset"])
            data = file.read(entry["bytes"])
            if zlib.crc32(data) != entry["crc32"]:
                raise SnapshotError(f"{path}: section {entry['name']} is damaged")
            total.update(f"{entry['name']} {entry['first']} {entry['bytes']}\n".encode())
            total.update(data)
    first, inserted, _ = header["state"]["buffer"]
    return SnapshotFacts(path, inserted - first, inserted, header["fits"], total.hexdigest(), "")
