"""Arenas generated from a seed: the families `corridor` (closed loops) and `forest` (pillars in a yard).

Equal family and seed give an equal arena. Proposals are drawn until one passes the check of its family.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena, ArenaError, Pillar, Wall

POOL_SIZE = 32
"""Arenas that `corridor:*` and `forest:*` stand for."""
MAX_PROPOSALS = 2000
WALL_THICKNESS_M = 0.15  # as in the shipped arenas
WALL_HEIGHT_M = 1.0

CORRIDOR_CORNERS = (6, 11)
CORRIDOR_RADIUS_M = (2.5, 6.5)
CORRIDOR_WIDTH_M = (1.2, 1.8)  # the shipped ones have 1.16 to 2.36
CORRIDOR_MAX_TURN_RAD = math.radians(110.0)
CORRIDOR_MIN_LEG_M = 2.0

YARD_M = 10.0
FOREST_PILLARS = (10, 18)
FOREST_RADIUS_M = (0.1, 0.45)
FOREST_GAP_M = 1.3  # a bat can circle in it: the least width in which the thesis's robot can turn round


@cache
def generate_arena(family: str, seed: int) -> Arena:
    """Returns the arena of a family (a key of `FAMILIES`) and a seed."""
    generator = np.random.default_rng([*family.encode(), seed])
    for _ in range(MAX_PROPOSALS):
        arena = FAMILIES[family](generator, f"{family}:{seed}")
        if arena is not None:
            return arena
    raise ArenaError(f"{family}:{seed}: no arena was found in {MAX_PROPOSALS} proposals; take another seed")


def _corridor(generator: np.random.Generator, name: str) -> Arena | None:
    """Returns a corridor whose middle is a polygon around the origin, or None if the proposal is too tight."""
    num_corners = int(generator.integers(*CORRIDOR_CORNERS))
    spread_rad = (np.arange(num_corners) + generator.uniform(-0.3, 0.3, num_corners)) * (2 * np.pi / num_corners)
    radius_m = generator.uniform(*CORRIDOR_RADIUS_M, num_corners)
    middle = np.round(radius_m[:, None] * np.c_[np.cos(spread_rad), np.sin(spread_rad)], 3)
    width_m = generator.uniform(*CORRIDOR_WIDTH_M, num_corners)
    leg = np.roll(middle, -1, axis=0) - middle
    direction_rad = np.arctan2(leg[:, 1], leg[:, 0])
    turn_rad = (direction_rad - np.roll(direction_rad, 1) + np.pi) % (2 * np.pi) - np.pi
    if np.hypot(*leg.T).min() < CORRIDOR_MIN_LEG_M or np.abs(turn_rad).max() > CORRIDOR_MAX_TURN_RAD:
        return None
    outward_rad = direction_rad - turn_rad / 2 - np.pi / 2
    reach_m = (width_m + WALL_THICKNESS_M) / 2 / np.cos(turn_rad / 2)
    offset = reach_m[:, None] * np.c_[np.cos(outward_rad), np.sin(outward_rad)]
    start = (middle[0] + middle[1]) / 2
    arena = Arena(
        name=name,
        about="generated: a closed corridor with random turns and widths",
        start=(float(start[0]), float(start[1])),
        walls=(*_fence(middle + offset), *_fence(middle - offset)),
        centre_line=tuple((float(x), float(y)) for x, y in middle),
    )
    line = np.concatenate([middle + share * leg for share in np.linspace(0.0, 1.0, 30)])
    clearance_m = ground_plan([arena]).clearance_m(line, np.zeros(len(line), np.int64))
    return arena if clearance_m.min() > 0.95 * CORRIDOR_WIDTH_M[0] / 2 else None


def _forest(generator: np.random.Generator, name: str) -> Arena | None:
    """Returns a square yard with pillars, or None if too few found room."""
    half_m = YARD_M / 2
    corners = np.array([(-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m)])
    wanted = int(generator.integers(*FOREST_PILLARS))
    pillars: list[Pillar] = []
    for _ in range(40 * wanted):
        radius_m = generator.uniform(*FOREST_RADIUS_M)
        room_m = half_m - radius_m - FOREST_GAP_M
        x_m, y_m = generator.uniform(-room_m, room_m, 2)
        gaps_m = [math.hypot(x_m - p.x_m, y_m - p.y_m) - radius_m - p.radius_m for p in pillars]
        if min(gaps_m, default=math.inf) > FOREST_GAP_M:
            pillars.append(Pillar(round(float(x_m), 3), round(float(y_m), 3), round(radius_m, 3), WALL_HEIGHT_M))
        if len(pillars) == wanted:
            edge_m = half_m - FOREST_GAP_M / 2
            return Arena(
                name=name,
                about="generated: pillars in a walled yard",
                start=(-edge_m, -edge_m),
                walls=_fence(corners),
                pillars=tuple(pillars),
            )
    return None


def _fence(corners: NDArray[np.float64]) -> tuple[Wall, ...]:
    """Returns walls between consecutive corners of a closed polygon, long enough to close it."""
    walls = []
    for first, last in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        (x_m, y_m), (dx, dy) = (first + last) / 2, last - first
        length_m = math.hypot(dx, dy) + WALL_THICKNESS_M
        walls.append(Wall(float(x_m), float(y_m), math.atan2(dy, dx), length_m, WALL_THICKNESS_M, WALL_HEIGHT_M))
    return tuple(walls)


FAMILIES: Mapping[str, Callable[[np.random.Generator, str], Arena | None]] = MappingProxyType(
    {"corridor": _corridor, "forest": _forest}
)
"""Each draws a proposal, named as told, or returns None."""
