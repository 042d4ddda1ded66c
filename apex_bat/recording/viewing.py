"""Finding the recordings of a run and opening them in the rerun viewer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from apex_bat.storage import StorageError


def recordings(run: Path) -> list[Path]:
    """Returns the flight recordings of a run, by name.

    Raises:
        StorageError: there are none.
    """
    paths = sorted((run / "recordings").glob("*.rrd"))
    if not paths:
        raise StorageError(f"{run}: no recordings; `apex-bat evaluate {run} --record 3` makes some")
    return paths


def open_viewer(run: Path, paths: list[Path], *, web: bool) -> int:
    """Opens recordings with the run's flight blueprint, listening on loopback only; returns the viewer's exit code."""
    blueprint = run / "recordings" / "flight.rbl"
    command = [sys.executable, "-m", "rerun", *map(str, paths), *([str(blueprint)] if blueprint.exists() else []),
               "--bind", "127.0.0.1", *(["--web-viewer"] if web else ["--port", "auto"])]  # fmt: skip
    return subprocess.run(command, check=False).returncode  # noqa: S603  # our own command


def draw(recording: Path, picture: Path) -> None:
    """Draws a recorded flight without a viewer: top view and echo strip.

    Raises:
        RecordingError: the recording cannot be read.
    """
    from apex_bat.recording.picture import draw_flight
    from apex_bat.recording.reading import read_flight, read_settings

    draw_flight(read_flight(recording), read_settings(recording).arena, picture)
