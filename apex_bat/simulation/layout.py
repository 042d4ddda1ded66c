"""What an arena is made of: walls, pillars, models from URDF files, a start and perhaps a centre line.

Lengths in metres, angles in radians counter-clockwise, x and y in the arena's own plane; everything stands on z = 0.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from msgspec import Struct


class ArenaError(ValueError):
    """An arena that does not exist, cannot be read, is malformed, or leaves a bat no safe start."""


class Wall(NamedTuple):
    """An upright box that stands on the floor."""

    x_m: float
    y_m: float
    yaw_rad: float
    """Direction of its length."""
    length_m: float
    thickness_m: float
    height_m: float


MAX_AREA_M2 = 10_000.0
"""Of the rectangle around an arena: a grid of it must fit into memory, and the thesis's take some 200."""


class Pillar(NamedTuple):
    """An upright cylinder that stands on the floor."""

    x_m: float
    y_m: float
    radius_m: float
    height_m: float


class Model(NamedTuple):
    """A URDF file, placed in the arena as a fixed body."""

    file: str
    """Path; a relative one counts from the arena's file."""
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


class Arena(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where bats fly."""

    name: str = ""
    """What results call it; the file's name, if the file gives none."""
    about: str = ""
    """Where the geometry comes from."""
    start: tuple[float, float]
    """x, y in metres of a point inside the drivable region."""
    walls: tuple[Wall, ...] = ()
    pillars: tuple[Pillar, ...] = ()
    models: tuple[Model, ...] = ()
    centre_line: tuple[tuple[float, float], ...] = ()
    """Corners x, y in metres of the closed middle of a corridor loop, counter-clockwise; empty: there is none."""

    def __post_init__(self) -> None:
        for number, wall in enumerate(self.walls):
            _check(f"wall {number}", wall._asdict())
        for number, pillar in enumerate(self.pillars):
            _check(f"pillar {number}", pillar._asdict())
        for number, model in enumerate(self.models):
            _check(f"model {number}", model._asdict())
        if not all(math.isfinite(value) for corner in (self.start, *self.centre_line) for value in corner):
            raise ValueError("start and centre_line must be finite numbers")
        if self.centre_line and len(self.centre_line) < 3:
            raise ValueError(f"centre_line has {len(self.centre_line)} corners; a closed line needs at least 3")
        if not (self.walls or self.pillars or self.models):
            raise ValueError("there are neither walls nor pillars nor models")
        (left, right), (low, high) = ((min(values), max(values)) for values in zip(*self.corners(), strict=True))
        if not (right - left) * (high - low) <= MAX_AREA_M2:  # also true of what is not a number
            raise ValueError(f"{right - left:g} by {high - low:g} m; at most {MAX_AREA_M2:g} square metres")

    @property
    def top_m(self) -> float | None:
        """Height of all bodies, where all are upright and of one height; None where they are not."""
        heights_m = {wall.height_m for wall in self.walls} | {pillar.height_m for pillar in self.pillars}
        return heights_m.pop() if len(heights_m) == 1 and not self.models else None

    def corners(self) -> list[tuple[float, float]]:
        """Returns points x, y in metres whose bounding box holds all walls and pillars, and the start."""
        points = [self.start]
        for wall in self.walls:
            along = (math.cos(wall.yaw_rad) * wall.length_m / 2, math.sin(wall.yaw_rad) * wall.length_m / 2)
            across = (-math.sin(wall.yaw_rad) * wall.thickness_m / 2, math.cos(wall.yaw_rad) * wall.thickness_m / 2)
            points += [
                (wall.x_m + i * along[0] + j * across[0], wall.y_m + i * along[1] + j * across[1])
                for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))
            ]
        for x_m, y_m, radius_m, _ in self.pillars:
            points += [(x_m - radius_m, y_m - radius_m), (x_m + radius_m, y_m + radius_m)]
        return points


def _check(label: str, fields: dict[str, Any]) -> None:
    for field, value in fields.items():
        if isinstance(value, str):
            continue
        if not math.isfinite(value):
            raise ValueError(f"{label}: {field} is {value}; it must be a finite number")
        if field in ("length_m", "thickness_m", "height_m", "radius_m") and value <= 0:
            raise ValueError(f"{label}: {field} is {value}; it must be greater than 0")
