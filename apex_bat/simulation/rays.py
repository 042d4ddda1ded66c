"""The range sensors: ray directions, and the two ways to cast them.

Both casters return the distance along each ray to the first surface, and inf for a miss. They meet the same surfaces
(see apex_bat.simulation.bodies). Embree takes 0.15 us a ray in the arena simple; PyBullet takes 5.5 us.

Where all bodies are upright and of one height, as in the thesis's arenas, a ray that rises at the elevation e meets what
the level ray of its azimuth meets at the distance d, at the range d / cos e, unless it has risen above the bodies by
then. So one level ray stands for a whole column of the 3D sensor: 460 rays are cast instead of 1360.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from apex_bat.config.settings import Rays
from apex_bat.simulation.bodies import RAY_GROUP
from apex_bat.simulation.bullet import pybullet
from apex_bat.simulation.world import World

Caster = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
"""Takes origins and unit directions, float32 (rays, 3) each; returns distances, float32 (rays,), inf for a miss."""


class RangeSensors:
    """The 3D sensor ahead, for the ear, and the 2D sensor around, for the reward; both cast in one go for all bats."""

    def __init__(self, settings: Rays, height_m: float, cast: Caster, top_m: float | None = None) -> None:
        """Lays out the rays.

        Args:
            settings: number and layout of rays.
            height_m: height of both sensors above the floor.
            cast: a caster.
            top_m: height of all bodies, where all are upright and higher than the sensors; None: cast every ray.
        """
        self._cast = cast
        self._height_m = height_m
        self.azimuth_rad, self.elevation_rad = ray_angles(settings)
        ahead = directions(self.azimuth_rad, self.elevation_rad)
        self._reach_m, self._stretch = np.full((1, 1), np.inf, np.float32), np.ones((1, 1), np.float32)
        if top_m is not None:
            row_rad = self.elevation_rad[:: settings.num_azimuth, None]
            ahead = directions(self.azimuth_rad[: settings.num_azimuth], np.zeros(settings.num_azimuth))
            self._reach_m, self._stretch = level_reach(row_rad, top_m - height_m, settings.max_range_m)
        around_rad = np.arange(settings.num_clearance, dtype=np.float64) * (2.0 * np.pi / settings.num_clearance)
        rays = np.concatenate([ahead, directions(around_rad, np.zeros_like(around_rad))])
        self._num_ahead = len(ahead)
        self._ahead, self._aside, self._up = np.ascontiguousarray(rays.T, np.float32)

    def measure(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Returns what the sensors read.

        Args:
            poses: float64 (bats, 3): x, y, heading in the world's coordinates.

        Returns:
            float32 (bats, points), the ranges of the 3D sensor, inf for a miss, and float64 (bats,), the smallest
            reading of the 2D sensor: the clearance s of the reward, from the middle of the robot.
        """
        num_bats, num_rays = len(poses), len(self._up)
        heading_rad = np.ascontiguousarray(poses[:, 2])
        cosine = np.cos(heading_rad).astype(np.float32)[:, None]
        sine = np.sin(heading_rad).astype(np.float32)[:, None]
        origins, rays = np.empty((2, num_bats, num_rays, 3), np.float32)
        rays[..., 0] = cosine * self._ahead - sine * self._aside
        rays[..., 1] = sine * self._ahead + cosine * self._aside
        rays[..., 2] = self._up
        origins[..., 0], origins[..., 1], origins[..., 2] = poses[:, :1], poses[:, 1:2], self._height_m
        distance_m = self._cast(origins.reshape(-1, 3), rays.reshape(-1, 3)).reshape(num_bats, num_rays)
        ahead_m = distance_m[:, None, : self._num_ahead]
        range_m = np.where(ahead_m <= self._reach_m, ahead_m * self._stretch, np.float32(np.inf))
        clearance_m = distance_m[:, self._num_ahead :].min(axis=1)
        return range_m.reshape(num_bats, -1), clearance_m.astype(np.float64)


def make_sensors(settings: Rays, height_m: float, world: World) -> RangeSensors:
    """Returns the sensors that the settings ask for; with Embree, level rays stand for columns where they can."""
    if settings.caster == "pybullet":
        return RangeSensors(settings, height_m, pybullet_caster(world.client, settings.max_range_m))
    is_flat = world.top_m is not None and world.top_m > height_m
    caster = embree_caster(world.triangles, settings.max_range_m)
    return RangeSensors(settings, height_m, caster, world.top_m if is_flat else None)


def level_reach(
    elevation_rad: NDArray[np.float64], rise_m: float, max_range_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns how far on the level rays may meet bodies, and by how much their ranges are longer than that distance.

    Args:
        elevation_rad: float64, from 0 to below pi / 2.
        rise_m: how far the bodies reach above the sensor.
        max_range_m: the longest range.

    Returns:
        float32, min(rise / tan e, max_range cos e), and float32, 1 / cos e; of the shape of the elevations.
    """
    with np.errstate(divide="ignore"):  # a level ray stays below the top for ever
        below_top_m = rise_m / np.tan(elevation_rad)
    level = np.cos(elevation_rad)
    return np.minimum(below_top_m, max_range_m * level).astype(np.float32), (1.0 / level).astype(np.float32)


def ray_angles(settings: Rays) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns azimuth and elevation in radians of the 3D sensor's rays, float64 (points,) each, row by row from below.

    Rays stand on both ends of the spans; a single column looks ahead, a single row level; a full circle has no end.
    """
    half_rad = math.radians(settings.azimuth_span_deg) / 2.0
    columns: NDArray[np.float64] = np.linspace(
        -half_rad, half_rad, settings.num_azimuth, endpoint=settings.azimuth_span_deg < 360.0
    )
    if settings.num_azimuth == 1:
        columns = np.zeros(1)
    rows = np.linspace(0.0, math.radians(settings.max_elevation_deg), settings.num_elevation)
    elevation_rad, azimuth_rad = np.meshgrid(rows, columns, indexing="ij")
    return azimuth_rad.ravel(), elevation_rad.ravel()


def directions(azimuth_rad: NDArray[np.float64], elevation_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns unit vectors (points, 3): x forward, y left, z up; azimuth counter-clockwise, elevation up."""
    level = np.cos(elevation_rad)
    return np.stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=1)


def embree_caster(triangles: NDArray[np.float32], max_range_m: float) -> Caster:
    """Returns a caster over triangles, float32 (n, 3, 3), by Embree."""
    scene = EmbreeScene()
    TriangleMesh(scene, triangles)

    def cast(origins: NDArray[np.float32], rays: NDArray[np.float32]) -> NDArray[np.float32]:
        range_m: NDArray[np.float32] = scene.run(origins, rays, query="DISTANCE")
        range_m[range_m > max_range_m] = np.inf  # Embree says 1e37 for a miss
        return range_m

    return cast


def pybullet_caster(client: int, max_range_m: float) -> Caster:
    """Returns a caster over the bodies of a PyBullet client, on one thread."""
    batch = int(pybullet.MAX_RAY_INTERSECTION_BATCH_SIZE) - 1

    def cast(origins: NDArray[np.float32], rays: NDArray[np.float32]) -> NDArray[np.float32]:
        ends = origins + max_range_m * rays.astype(np.float64)
        hits = [
            hit
            for first in range(0, len(origins), batch)
            for hit in pybullet.rayTestBatch(
                origins[first : first + batch].tolist(),
                ends[first : first + batch].tolist(),
                numThreads=1,
                collisionFilterMask=RAY_GROUP,
                physicsClientId=client,
            )
        ]
        fraction = np.array([hit[2] if hit[0] >= 0 else np.inf for hit in hits])
        return (max_range_m * fraction).astype(np.float32)

    return cast
