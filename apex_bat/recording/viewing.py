"""Opening recordings in the rerun viewer: repaired where needed, laid out, listening on loopback only."""

from __future__ import annotations

import subprocess
import sys
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

import rerun.blueprint as rrb
from rerun.chunk import Chunk, LazyChunkStream

from apex_bat.recording.blueprints import PAIR
from apex_bat.recording.reading import is_whole, read_chunks, repair_recording

PAIR_APPLICATION_ID = "apex_bat_pair"
"""Two flights in one recording have another layout than one, and a layout belongs to an application."""


def open_viewer(paths: Sequence[Path], layout: Path, *, web: bool) -> int:
    """Opens recordings in a viewer of their own, waits until it is closed, and returns its exit code.

    Args:
        paths: the recordings; the last is shown first.
        layout: an .rbl that replaces the layout inside the recordings: the last one wins.
        web: in the browser.
    """
    command = [sys.executable, "-m", "rerun", *map(str, paths), str(layout), "--bind", "127.0.0.1", "--port", "auto"]
    command += ["--web-viewer", "--web-viewer-port", "0"] if web else []
    return subprocess.run(command, check=False).returncode  # noqa: S603  # our own command


def whole_copies(paths: Sequence[Path], folder: Path) -> list[Path]:
    """Returns the recordings, a repaired copy in the folder in place of each that was cut short.

    Raises:
        RecordingError: one cannot be repaired.
    """
    return [path if is_whole(path) else _repaired(path, folder) for path in paths]


def save_layout(blueprint: rrb.Blueprint, application_id: str, folder: Path) -> Path:
    """Writes a layout into a folder and returns its path."""
    path = folder / "layout.rbl"
    blueprint.save(application_id, path)
    return path


def write_pair(one: Path, other: Path, path: Path) -> None:
    """Writes a recording that holds two flights side by side: their entities below `a` and below `b`.

    The viewer shows only one recording at a time, so that two can be seen together only in this way.

    Raises:
        RecordingError: one of them cannot be read.
    """
    chunks = LazyChunkStream.from_iter([*_below(PAIR[0], one), *_below(PAIR[1], other)])
    chunks.write_rrd(path, application_id=PAIR_APPLICATION_ID, recording_id=str(uuid.uuid4()))


def _below(prefix: str, path: Path) -> Iterator[Chunk]:
    for chunk in read_chunks(path):
        if not chunk.entity_path.startswith("/__properties"):
            yield chunk.with_entity_path(f"/{prefix}{chunk.entity_path}")


def _repaired(path: Path, folder: Path) -> Path:
    """A copy with an index."""
    copy = folder / f"{path.name.removesuffix('.part').removesuffix('.rrd')}.rrd"
    repair_recording(path, copy)
    return copy
