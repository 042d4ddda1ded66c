"""Finding the recordings of a run and opening them in the rerun viewer."""

from __future__ import annotations

import os
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
    command = [sys.executable, "-m", "rerun", *([str(blueprint)] if blueprint.exists() else []), *map(str, paths),
               "--bind", "127.0.0.1", *(["--web-viewer"] if web else ["--port", "auto"])]  # fmt: skip
    environment = os.environ | {"RERUN_ANALYTICS": "0"}
    return subprocess.run(command, env=environment, check=False).returncode  # noqa: S603  # our own command


def draw(recording: Path, picture: Path) -> None:
    """Draws a recorded flight without a viewer: top view and echo strip.

    Raises:
        StorageError: the recording cannot be read.
    """
    from apex_bat.recording.picture import draw_flight
    from apex_bat.recording.reading import read_flight
    from apex_bat.simulation.arenas import load_arena

    flight = read_flight(recording)
    draw_flight(flight, load_arena(flight.facts.arena), picture)
