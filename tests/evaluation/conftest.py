"""Judged policies made up from chosen outcomes, for reports and claims without any training."""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest

from apex_bat.config import Config
from apex_bat.evaluation.flights import FlightRecord
from apex_bat.evaluation.results import ARENAS, Curve, Judged, Trace

MakeJudged = Callable[..., Judged]


def record(arena: str, flight: int, steps: int, *, is_complete: bool, straight: float) -> FlightRecord:
    """A flight of so many steps."""
    turns = (1.0 - straight) / 2
    return FlightRecord(
        condition="memory", arena=arena, seed=1, flight=flight, start=(0.0, 0.0, 0.0), steps=steps,
        completed=is_complete, collided=not is_complete, distance_m=0.15 * steps, progress_m=0.14 * steps,
        reward=1.0, action_shares=(straight, turns, turns), clearance_quantiles_m=(0.2, 0.3, 0.4, 0.5, 0.6, 0.7),
    )  # fmt: skip


def judged(
    condition: str,
    seed: int = 0,
    *,
    completed: Sequence[int] = (15, 15, 15),
    straight: float = 0.7,
    num_flights: int = 15,
    config: Config | None = None,
    **facts: Any,
) -> Judged:
    """A policy that completes so many flights in simple, narrow and circle; the others end after about 100 steps."""
    chance = np.random.default_rng(seed)
    records = []
    for arena, number in zip(ARENAS, completed, strict=True):
        for flight in range(num_flights):
            steps = 1000 if flight < number else int(chance.integers(50, 150))
            share = float(np.clip(straight + 0.05 * chance.standard_normal(), 0.0, 1.0))
            records.append(record(arena, flight, steps, is_complete=flight < number, straight=share))
    place = {"simple": (3.811, -0.6), "narrow": (3.239, -0.51), "circle": (0.0, 0.0)}
    clearance_m, actions = np.array([0.5, 0.6, 0.7, 0.6], np.float32), np.array([0, 1, 2, 0], np.uint8)
    poses = {arena: np.tile(np.array([*middle, 1.5], np.float32), (5, 1)) for arena, middle in place.items()}
    traces = [Trace(poses[each.arena], clearance_m, actions) for each in records]
    base = msgspec.structs.replace(config or Config(), seed=seed, condition=condition)
    known = {
        "env_steps": 180_000,
        "learner_steps": 22_000,
        "seed": seed,
        "commit": "0123456789abcdef",
        "host": "lab",
        "outcome": "completed",
    }
    curve = Curve(np.array([1e4, 2e4, 3e4]) + 100 * seed, np.array([0.0, 0.5, 0.9]), np.array([1.0, 70.0, 140.0]))
    return Judged(f"{condition}-{seed}", condition, base, records, traces, known | facts, curve)


@pytest.fixture
def make_judged() -> MakeJudged:
    """Makes a judged policy; see `judged`."""
    return judged
