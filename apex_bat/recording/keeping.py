"""What a run keeps of its flights: which are recorded, pictures of the first, and how much disk they take.

The best, the worst and some crashes carry a mark in their names and go last when the disk bound is reached.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import get_args

from apex_bat.config import Config
from apex_bat.config.settings import Recording
from apex_bat.recording.blueprints import save_blueprints
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.flight import Flight, Mark
from apex_bat.recording.hearing import Directions
from apex_bat.recording.picture import draw_flight
from apex_bat.recording.training import TRAINING_RECORDING
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.rays import ray_angles

MOST_LOGGED = 64
"""Flights of an evaluation among which the best, the worst and the crashes are sought; each takes up to 2 MB."""


def num_logged(settings: Recording, num_first: int) -> int:
    """Returns how many flights of an evaluation must be logged whole so that `choose` can choose."""
    if num_first == 0:
        return 0
    return max(num_first, MOST_LOGGED if settings.extremes or settings.crashes else 0)


def choose(flights: Sequence[Flight], settings: Recording, num_first: int) -> list[Flight]:
    """Returns which flights of an evaluation in one arena are recorded, each once, with its mark.

    Args:
        flights: in the order of their numbers.
        settings: whether the extremes are wanted, and how many crashes.
        num_first: how many of the first are recorded in any case; 0: none at all.
    """
    if not flights or num_first == 0:
        return []
    marks: dict[int, Mark] = dict.fromkeys(range(min(num_first, len(flights))), "")
    if settings.extremes:
        order = sorted(range(len(flights)), key=lambda i: merit(flights[i]))
        marks |= {order[0]: "worst", order[-1]: "best"}
    crashes = [i for i, flight in enumerate(flights) if flight.contact.any() and not marks.get(i)]
    crashes.sort(key=lambda i: -flights[i].num_steps)  # a start that faces a wall tells less
    marks |= dict.fromkeys(crashes[: settings.crashes], "crash")
    return [replace(flights[i], facts=replace(flights[i].facts, mark=marks[i])) for i in sorted(marks)]


def merit(flight: Flight) -> tuple[bool, float]:
    """Returns what ranks flights: whether it reached the time limit, then the way along the corridor in m."""
    return flight.end == "time", abs(float(flight.progress_m[-1]))


def keep_flights(
    flights: Sequence[Flight], config: Config, run: Path, *, num_first: int | None = None, draw: bool = True
) -> list[Path]:
    """Writes flights to `recordings/` and returns the paths.

    Args:
        flights: of one or several arenas, those of each together and in order.
        config: settings that they were flown with.
        run: the run folder.
        num_first: record the first so many of each arena and what else `choose` finds; None: record all.
        draw: whether a picture of the first in each arena is drawn into `figures/`.
    """
    folder, directions, paths = run / "recordings", Directions(*ray_angles(config.rays)), []
    for name, group in groupby(flights, key=lambda flight: flight.facts.arena):
        arena, of_arena = load_arena(name), list(group)
        if not (folder / "policy.rbl").exists():
            save_blueprints(folder, arena)
        chosen = of_arena if num_first is None else choose(of_arena, config.recording, num_first)
        for number, flight in enumerate(chosen):
            paths.append(folder / flight.facts.file_name())
            for mark in get_args(Mark):  # the same flight may have got another mark among other flights before
                (folder / replace(flight.facts, mark=mark).file_name()).unlink(missing_ok=True)
            write_flight(flight, arena, config.sonar, directions, paths[-1])
            if draw and number == 0:
                draw_flight(flight, arena, run / "figures" / f"{paths[-1].stem}.png")
    prune(folder, config.recording.max_mb)
    return paths


def prune(folder: Path, max_mb: float) -> list[Path]:
    """Deletes flight recordings of a folder until all take at most `max_mb` megabytes; returns what was deleted.

    Training flights and what killed processes left go first, then evaluation flights, then marked ones, the oldest
    first; the newest recording always stays. Whoever wants to keep one moves it to another folder.
    """
    sizes = {path: stat for path in folder.glob("*.rrd*") if (stat := _stat(path)) is not None}
    order = sorted(sizes, key=lambda path: (_rank(path), sizes[path].st_mtime_ns, path.name))
    newest = max((stat.st_mtime_ns for stat in sizes.values()), default=0)
    excess = sum(stat.st_size for stat in sizes.values()) - max_mb * 1e6
    deleted = []
    for path in order:
        if excess > 0 and sizes[path].st_mtime_ns != newest and path.name != TRAINING_RECORDING:
            path.unlink(missing_ok=True)
            excess -= sizes[path].st_size
            deleted.append(path)
    return deleted


def _rank(path: Path) -> int:
    """How dear a recording is."""
    if not path.name.startswith("evaluation") or path.suffix == ".part":
        return 0
    return 2 if path.stem.endswith(("-best", "-worst", "-crash")) else 1


def _stat(path: Path) -> os.stat_result | None:
    """Size and age of a file; None when another process has just deleted or renamed it."""
    try:
        return path.stat()
    except FileNotFoundError:
        return None
