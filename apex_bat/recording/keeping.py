"""What a run keeps of its flights: a recording, and a picture of the first one in each arena."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from apex_bat.config import Config
from apex_bat.recording.blueprints import save_blueprints
from apex_bat.recording.episodes import prune, write_flight
from apex_bat.recording.flight import Flight
from apex_bat.recording.hearing import Directions
from apex_bat.recording.picture import draw_flight
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.rays import ray_angles


def keep_flights(flights: Sequence[Flight], config: Config, run: Path, *, draw: bool = True) -> None:
    """Writes flights to `recordings/` and, if asked to, a picture of the first in each arena to `figures/`."""
    if not flights:
        return
    recordings = run / "recordings"
    save_blueprints(recordings)
    directions = Directions(*ray_angles(config.rays))
    drawn: set[str] = set()
    for flight in flights:
        arena = load_arena(flight.facts.arena)
        path = recordings / flight.facts.file_name()
        write_flight(flight, arena, config.sonar, directions, path)
        if draw and arena.name not in drawn:
            drawn.add(arena.name)
            draw_flight(flight, arena, run / "figures" / f"{path.stem}.png")
    prune(recordings, config.recording.max_mb)
