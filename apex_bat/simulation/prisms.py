"""What need not be cast where all bodies are upright prisms or cylinders of one height, as in the thesis's arenas.

- A ray that rises at the elevation e meets what the level ray of its azimuth meets at the distance d, at the range
  d / cos e, unless it has risen above the bodies by then. So one level ray stands for a whole column of the 3D sensor.
- The bodies' footprints are convex. The part of a convex footprint that is nearer than some distance is convex too, so
  that the directions in which it is seen are an interval, around the bearing of its nearest point. So if any ray of the
  2D sensor meets it nearer than that, one of the two next to that bearing does: the smallest reading of all rays is
  that of two rays a footprint.

Together this leaves 124 of 1360 rays in the arena simple. Readings are those of the full cast; only at a pillar, whose
mesh lies up to 0.1 mm inside its circle, may the clearance differ by as much.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.simulation.ground import Ground


class Prisms(NamedTuple):
    """The bodies of a world in which all are upright, of one height, and higher than the sensors."""

    ground: Ground
    """Their footprints, in the coordinates of each arena."""
    offsets_m: NDArray[np.float64]
    """(arenas, 2), where the origin of each arena lies in the world."""
    top_m: float
    """Their height."""

    def nearest_rays(
        self, poses: NDArray[np.float64], arena: NDArray[np.int64], num_around: int
    ) -> NDArray[np.int64] | None:
        """Returns which rays of a 2D sensor can have its smallest reading: the two next to each footprint's bearing.

        Args:
            poses: float64 (bats, 3): x, y, heading in the world's coordinates, outside all bodies.
            arena: int64 (bats,), the arena that each is in.
            num_around: how many rays the sensor has, evenly around, counter-clockwise from the heading.

        Returns:
            int64 (bats, 2 x footprints), or None where that would not be fewer than all.
        """
        footprints = self.ground.boxes.shape[1] + self.ground.circles.shape[1]
        if 2 * footprints >= num_around:
            return None
        bearing_rad = self.ground.bearing_rad(poses[:, :2] - self.offsets_m[arena], arena)
        below = np.floor((bearing_rad - poses[:, 2:]) * (num_around / (2.0 * np.pi))).astype(np.int64)
        return np.concatenate([below, below + 1], axis=1) % num_around


def level_reach(
    elevation_rad: NDArray[np.float64], rise_m: float, max_range_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns how far off rising rays meet prisms, and by how much their ranges exceed that level distance.

    Args:
        elevation_rad: float64, from 0 to below pi / 2.
        rise_m: how far the prisms reach above the sensor.
        max_range_m: the longest range.

    Returns:
        float32, min(rise / tan e, max_range cos e) in metres, and float32, 1 / cos e; of the shape of the elevations.
    """
    with np.errstate(divide="ignore"):  # a level ray stays below the top for ever
        below_top_m = rise_m / np.tan(elevation_rad)
    level = np.cos(elevation_rad)
    return np.minimum(below_top_m, max_range_m * level).astype(np.float32), (1.0 / level).astype(np.float32)
