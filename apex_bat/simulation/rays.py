"""The range sensors: ray directions, and the two ways to cast them.

Both casters return the distance along each ray to the first surface, and inf for a miss. They meet the same surfaces
(see apex_bat.simulation.bodies). 16 bats' 21,760 rays take Embree 0.19 ms a bat in the arena simple; PyBullet takes
7.4 ms (one core of a shared machine).
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

    def __init__(self, settings: Rays, height_m: float, cast: Caster) -> None:
        """Lays out the rays.

        Args:
            settings: number and layout of rays.
            height_m: height of both sensors above the floor.
            cast: a caster.
        """
        self._cast = cast
        self._height_m = height_m
        self.azimuth_rad, self.elevation_rad = ray_angles(settings)
        around_rad = np.arange(settings.num_clearance, dtype=np.float64) * (2.0 * np.pi / settings.num_clearance)
        ahead = directions(self.azimuth_rad, self.elevation_rad)
        rays = np.concatenate([ahead, directions(around_rad, np.zeros_like(around_rad))])
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
        rays = np.empty((num_bats, num_rays, 3), np.float32)
        rays[:, :, 0] = cosine * self._ahead - sine * self._aside
        rays[:, :, 1] = sine * self._ahead + cosine * self._aside
        rays[:, :, 2] = self._up
        sensors = np.column_stack([poses[:, :2], np.full(num_bats, self._height_m)]).astype(np.float32)
        origins = np.repeat(sensors, num_rays, axis=0)
        range_m = self._cast(origins, rays.reshape(-1, 3)).reshape(num_bats, num_rays)
        points = len(self.azimuth_rad)
        return range_m[:, :points], range_m[:, points:].min(axis=1).astype(np.float64)


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


def make_caster(settings: Rays, world: World) -> Caster:
    """Returns the caster that the settings ask for."""
    if settings.caster == "embree":
        return embree_caster(world.triangles, settings.max_range_m)
    return pybullet_caster(world.client, settings.max_range_m)


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
