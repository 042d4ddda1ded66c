"""A made-up flight through a room, and its recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from apex_bat.config import settings
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.flight import Flight, FlightFacts, FlightLog
from apex_bat.recording.hearing import Directions
from apex_bat.simulation.layout import Arena, Pillar, Wall

NUM_STEPS = 130  # more than one block of a recording
MEMORY_STEPS = 3


def make_flight(num_steps: int = NUM_STEPS, num_points: int = 30, heavy_period_steps: int = 5) -> Flight:
    """A flight of random numbers: near from step 100, in contact at its end."""
    generator = np.random.default_rng(7)
    facts = FlightFacts(arena="room", condition="memory", kind="training", seed=3, episode=12, actor=4, epsilon=0.125)
    log = FlightLog(facts, MEMORY_STEPS, heavy_period_steps, max_steps=16)
    for step in range(num_steps):
        action = int(generator.integers(3))
        is_near = step >= 100
        ranges_m = generator.uniform(0.3, 6.0, num_points).astype(np.float32)
        ranges_m[generator.random(num_points) < 0.2] = np.inf
        log.append(
            pose=np.array([-1.5 + 0.02 * step, 0.1 * np.sin(step), 0.05 * step]),
            frame=generator.random((2, 24), np.float32),
            state=generator.random((2 * MEMORY_STEPS, 24), np.float32),
            q=generator.normal(size=3).astype(np.float32),
            value=float(generator.normal()),
            advantage=generator.normal(size=3).astype(np.float32),
            action=action,
            reward_straight=0.05 if action == 0 and not is_near else 0.0,
            reward_near=-0.005 if is_near else 0.0,
            reward=-0.005 if is_near else 0.05 if action == 0 else 0.0,
            clearance_m=float(generator.uniform(0.2, 1.0)),
            progress_m=0.1 * step,
            distance_m=0.15 * (step + 1),
            contact=step == num_steps - 1,
            ranges_m=ranges_m if num_points else None,
        )
    return log.finish(np.array([1.2, 0.3, 6.4]), "contact")


@pytest.fixture(scope="session")
def room() -> Arena:
    """Four walls and a pillar."""
    sides = [(2.0, 0.0, np.pi / 2), (-2.0, 0.0, np.pi / 2), (0.0, 2.0, 0.0), (0.0, -2.0, 0.0)]
    walls = tuple(Wall(x_m, y_m, yaw_rad, 4.0, 0.15, 1.0) for x_m, y_m, yaw_rad in sides)
    return Arena(name="room", start=(0.0, 0.0), walls=walls, pillars=(Pillar(0.5, 0.5, 0.2, 1.0),))


@pytest.fixture(scope="session")
def directions() -> Directions:
    """Thirty rays: ten columns, three rows."""
    azimuth_rad, elevation_rad = np.meshgrid(np.linspace(-1.5, 1.5, 10), np.linspace(0.0, 0.5, 3), indexing="ij")
    return Directions(azimuth_rad.ravel(), elevation_rad.ravel())


@pytest.fixture(scope="session")
def fly() -> Callable[..., Flight]:
    """What makes flights, from numbers of steps, points and heavy steps."""
    return make_flight


@pytest.fixture(scope="session")
def flight() -> Flight:
    """A flight with everything in it."""
    return make_flight()


@pytest.fixture(scope="session")
def recording(flight: Flight, room: Arena, directions: Directions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of `flight`, written with rerun's strict checks."""
    rr.set_strict_mode(True)
    path = tmp_path_factory.mktemp("recordings") / flight.facts.file_name()
    write_flight(flight, room, settings.Sonar(rendering="exact"), directions, path)
    return path
