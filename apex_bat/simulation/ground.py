"""The ground plan of arenas: signed distances from points to the footprints of walls, pillars and models.

Used where a ray would be too dear or too coarse: to draw safe starts, and to decide which bats PyBullet need look at
for contact. Footprints of models are the bounding boxes of their parts, which never overestimates a distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.simulation.layout import Arena
from apex_bat.simulation.models import model_parts

FAR_M = 1e6
"""Where the footprints stand that only fill up the arrays of arenas with fewer of them."""


class Ground(NamedTuple):
    """Footprints of several arenas, padded to the same number."""

    boxes: NDArray[np.float64]
    """(arenas, boxes, 6): x, y, cosine and sine of the yaw, half length, half thickness; walls, then model parts."""
    circles: NDArray[np.float64]
    """(arenas, circles, 3): x, y, radius."""

    def distance_m(self, points: NDArray[np.float64], arena: NDArray[np.int64]) -> NDArray[np.float64]:
        """Returns signed distances to each footprint, negative inside: float64 (points, boxes + circles).

        Args:
            points: float64 (points, 2).
            arena: int64 (points,), the arena that each point lies in.
        """
        x, y = points[:, :1], points[:, 1:2]
        boxes, circles = self._of(arena)
        dx, dy = x - boxes[:, :, 0], y - boxes[:, :, 1]
        cosine, sine = boxes[:, :, 2], boxes[:, :, 3]
        along = np.abs(cosine * dx + sine * dy) - boxes[:, :, 4]
        across = np.abs(cosine * dy - sine * dx) - boxes[:, :, 5]
        outside = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
        to_boxes = outside + np.minimum(np.maximum(along, across), 0.0)
        to_circles = np.hypot(x - circles[:, :, 0], y - circles[:, :, 1]) - circles[:, :, 2]
        return np.concatenate([to_boxes, to_circles], axis=1)

    def bearing_rad(self, points: NDArray[np.float64], arena: NDArray[np.int64]) -> NDArray[np.float64]:
        """Returns the directions from points to the nearest point of each footprint: float64 (points, boxes + circles).

        Args:
            points: float64 (points, 2), outside the footprints.
            arena: int64 (points,), the arena that each point lies in.
        """
        x, y = points[:, :1], points[:, 1:2]
        boxes, circles = self._of(arena)
        dx, dy = x - boxes[:, :, 0], y - boxes[:, :, 1]
        cosine, sine = boxes[:, :, 2], boxes[:, :, 3]
        along, across = cosine * dx + sine * dy, cosine * dy - sine * dx
        ahead = np.clip(along, -boxes[:, :, 4], boxes[:, :, 4]) - along
        aside = np.clip(across, -boxes[:, :, 5], boxes[:, :, 5]) - across
        to_x = np.concatenate([cosine * ahead - sine * aside, circles[:, :, 0] - x], axis=1)
        to_y = np.concatenate([sine * ahead + cosine * aside, circles[:, :, 1] - y], axis=1)
        return np.asarray(np.arctan2(to_y, to_x))

    def clearance_m(self, points: NDArray[np.float64], arena: NDArray[np.int64]) -> NDArray[np.float64]:
        """Returns the signed distance to the nearest footprint: float64 (points,)."""
        return np.asarray(self.distance_m(points, arena).min(axis=1))

    def _of(self, arena: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the footprints of some arenas; those of a single one need no copy for each point."""
        return (self.boxes[arena], self.circles[arena]) if len(self.boxes) > 1 else (self.boxes, self.circles)


def ground_plan(arenas: Sequence[Arena]) -> Ground:
    """Returns the footprints of arenas."""
    boxes = [_wall_boxes(arena) + _model_boxes(arena) for arena in arenas]
    circles = [[pillar[:3] for pillar in arena.pillars] for arena in arenas]
    far_box, far_circle = (FAR_M, FAR_M, 1.0, 0.0, 0.0, 0.0), (FAR_M, FAR_M, 0.0)
    most_boxes, most_circles = max(map(len, boxes)), max(map(len, circles))
    return Ground(
        np.array([rows + [far_box] * (most_boxes - len(rows)) for rows in boxes], float).reshape(len(arenas), -1, 6),
        np.array([rows + [far_circle] * (most_circles - len(rows)) for rows in circles], float).reshape(
            len(arenas), -1, 3
        ),
    )


def _wall_boxes(arena: Arena) -> list[tuple[float, ...]]:
    return [
        (wall.x_m, wall.y_m, np.cos(wall.yaw_rad), np.sin(wall.yaw_rad), wall.length_m / 2, wall.thickness_m / 2)
        for wall in arena.walls
    ]


def _model_boxes(arena: Arena) -> list[tuple[float, ...]]:
    boxes: list[tuple[float, ...]] = []
    for model in arena.models:
        for part in model_parts(model):
            low, high = part[:, :, :2].min(axis=(0, 1)), part[:, :, :2].max(axis=(0, 1))
            boxes.append((*((low + high) / 2), 1.0, 0.0, *((high - low) / 2)))
    return boxes
