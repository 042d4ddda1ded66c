"""The range sensors: ray directions, and the two ways to cast them.

Both casters return the distance along each ray to the first surface, and inf for a miss. They meet the same surfaces
(see apex_bat.simulation.bodies). Embree takes 0.15 us a ray in the arena simple; PyBullet takes 5.5 us.

Where all bodies are upright and of one height most rays need not be cast (see apex_bat.simulation.prisms).
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
from apex_bat.simulation.prisms import Prisms, level_reach
from apex_bat.simulation.world import World

Caster = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
"""Takes origins and unit directions, float32 (rays, 3) each; returns distances, float32 (rays,), inf for a miss."""


class RangeSensors:
    """The 3D sensor ahead, for the ear, and the 2D sensor around, for the reward; both cast in one go for all bats."""

    def __init__(self, settings: Rays, height_m: float, cast: Caster, prisms: Prisms | None = None) -> None:
        """Lays out the rays.

        Args:
            settings: number and layout of rays.
            height_m: height of both sensors above the floor.
            cast: a caster.
            prisms: the bodies, if fewer rays will do for them; None: every ray is cast.
        """
        self._cast, self._height_m, self._prisms = cast, height_m, prisms
        self.azimuth_rad, self.elevation_rad = ray_angles(settings)
        around_rad = np.arange(settings.num_clearance, dtype=np.float64) * (2.0 * np.pi / settings.num_clearance)
        self._around = directions(around_rad, np.zeros_like(around_rad)).astype(np.float32)
        self._ahead = directions(self.azimuth_rad, self.elevation_rad).astype(np.float32)
        self._reach_m, self._stretch = np.full((1, 1), np.inf, np.float32), np.ones((1, 1), np.float32)
        if prisms is not None:
            column_rad, row_rad = self.azimuth_rad[: settings.num_azimuth], self.elevation_rad[:: settings.num_azimuth]
            self._ahead = directions(column_rad, np.zeros_like(column_rad)).astype(np.float32)
            self._reach_m, self._stretch = level_reach(row_rad[:, None], prisms.top_m - height_m, settings.max_range_m)

    def measure(
        self, poses: NDArray[np.float64], arena: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Returns what the sensors read.

        Args:
            poses: float64 (bats, 3): x, y, heading in the world's coordinates.
            arena: int64 (bats,), the arena that each is in; None: the first.

        Returns:
            float32 (bats, points), the ranges of the 3D sensor, inf for a miss, and float64 (bats,), the smallest
            reading of the 2D sensor: the clearance s of the reward, from the middle of the robot.
        """
        num_ahead = len(self._ahead)
        level_m = self._distance_m(poses, np.zeros(len(poses), np.int64) if arena is None else arena)
        ahead_m, clearance_m = level_m[:, None, :num_ahead], level_m[:, num_ahead:].min(axis=1)
        range_m = np.where(ahead_m <= self._reach_m, ahead_m * self._stretch, np.float32(np.inf))
        return range_m.reshape(len(poses), -1), clearance_m.astype(np.float64)

    def _distance_m(self, poses: NDArray[np.float64], arena: NDArray[np.int64]) -> NDArray[np.float32]:
        """Returns the distances along the rays that are cast: float32 (bats, rays), first those ahead."""
        chosen = None if self._prisms is None else self._prisms.nearest_rays(poses, arena, len(self._around))
        num_bats, num_ahead = len(poses), len(self._ahead)
        around = self._around if chosen is None else self._around[chosen]
        local = np.empty((num_bats, num_ahead + around.shape[-2], 3), np.float32)
        local[:, :num_ahead], local[:, num_ahead:] = self._ahead, around
        # Contiguous copies: numpy may round sines of strided arrays differently, and then neighbours would matter.
        heading_rad = np.ascontiguousarray(poses[:, 2])
        cosine = np.cos(heading_rad).astype(np.float32)[:, None]
        sine = np.sin(heading_rad).astype(np.float32)[:, None]
        origins, rays = np.empty((2, *local.shape), np.float32)
        rays[..., 0] = cosine * local[..., 0] - sine * local[..., 1]
        rays[..., 1] = sine * local[..., 0] + cosine * local[..., 1]
        rays[..., 2] = local[..., 2]
        origins[..., 0], origins[..., 1], origins[..., 2] = poses[:, :1], poses[:, 1:2], self._height_m
        return self._cast(origins.reshape(-1, 3), rays.reshape(-1, 3)).reshape(num_bats, -1)


def make_sensors(settings: Rays, height_m: float, world: World) -> RangeSensors:
    """Returns the sensors that the settings ask for. PyBullet casts every ray; Embree no more than are needed."""
    if settings.caster == "pybullet":
        return RangeSensors(settings, height_m, pybullet_caster(world.client, settings.max_range_m))
    prisms = None
    if world.top_m is not None and world.top_m > height_m:
        prisms = Prisms(world.ground, world.offsets_m, world.top_m)
    return RangeSensors(settings, height_m, embree_caster(world.triangles, settings.max_range_m), prisms)


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
