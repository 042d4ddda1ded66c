"""Outlines of an arena seen from above, for pictures and views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.simulation.layout import Arena, Wall


class Extent(NamedTuple):
    """The rectangle around everything that stands in an arena, in metres."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float


def wall_corners_m(wall: Wall) -> NDArray[np.float64]:
    """Returns float64 (4, 2): the corners of a wall seen from above, counter-clockwise."""
    along = np.array([np.cos(wall.yaw_rad), np.sin(wall.yaw_rad)]) * wall.length_m / 2
    across = np.array([-np.sin(wall.yaw_rad), np.cos(wall.yaw_rad)]) * wall.thickness_m / 2
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], np.float64)
    corners: NDArray[np.float64] = (wall.x_m, wall.y_m) + signs @ np.stack([along, across])
    return corners


def model_triangles_m(arena: Arena) -> NDArray[np.float64]:
    """Returns float64 (triangles, 3, 3): the surfaces of all models of an arena; none without models."""
    if not arena.models:
        return np.empty((0, 3, 3))
    from apex_bat.simulation.models import model_parts  # PyBullet reads the files; only such arenas need it

    return np.concatenate([part for model in arena.models for part in model_parts(model)])


def arena_extent_m(arena: Arena) -> Extent:
    """Returns the rectangle around the walls, pillars and models of an arena."""
    points = np.concatenate([np.array(arena.corners()), model_triangles_m(arena)[..., :2].reshape(-1, 2)])
    low, high = points.min(axis=0), points.max(axis=0)
    return Extent(float(low[0]), float(high[0]), float(low[1]), float(high[1]))
