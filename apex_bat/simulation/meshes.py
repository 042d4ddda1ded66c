"""Closed triangle meshes of simple solids: float64 (triangles, 3 corners, 3 coordinates), in metres.

Round solids are replaced by polyhedra whose corners lie on them and whose faces are at most 0.1 mm inside.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Triangles = NDArray[np.float64]

SAGITTA_M = 1e-4
"""How far the flat faces may lie inside a round surface. Rays are to agree with the solid within 1 mm."""


def box_mesh(length_m: float, width_m: float, height_m: float) -> Triangles:
    """Returns a box around the origin: 12 triangles."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    return hull_mesh(signs * (length_m / 2, width_m / 2, height_m / 2))


def cylinder_mesh(radius_m: float, height_m: float) -> Triangles:
    """Returns a cylinder around the z axis, the origin in its middle."""
    angle_rad = np.arange(num_sides(radius_m)) * (2.0 * np.pi / num_sides(radius_m))
    low = np.stack(
        [radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad), np.full_like(angle_rad, -height_m / 2)], 1
    )
    up = np.array([0.0, 0.0, height_m])
    high = low + up
    next_low, next_high = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    foot, head = np.zeros_like(low) - up / 2, np.zeros_like(low) + up / 2
    faces = [(low, next_low, next_high), (low, next_high, high), (foot, next_low, low), (head, high, next_high)]
    return np.concatenate([np.stack(face, axis=1) for face in faces])


def sphere_mesh(radius_m: float) -> Triangles:
    """Returns a sphere around the origin."""
    return hull_mesh(_sphere_points(radius_m))


def capsule_mesh(radius_m: float, length_m: float) -> Triangles:
    """Returns the hull of two spheres whose centres lie `length_m` apart on the z axis, the origin in the middle."""
    points, half = _sphere_points(radius_m), np.array([0.0, 0.0, length_m / 2])
    return hull_mesh(np.concatenate([points + half, points - half]))


def hull_mesh(points: NDArray[np.float64]) -> Triangles:
    """Returns the convex hull of points (n, 3)."""
    from scipy.spatial import ConvexHull  # here: it takes 0.4 s to import, and few arenas have such meshes

    return np.asarray(points[ConvexHull(points).simplices], np.float64)


def num_sides(radius_m: float) -> int:
    """Returns how many sides a polygon inside a circle needs so that it is `SAGITTA_M` off at most; at least 16."""
    return max(16, math.ceil(math.pi / math.acos(1.0 - min(SAGITTA_M / radius_m, 1.0))))


def place_mesh(triangles: Triangles, position_m: NDArray[np.float64], rotation: NDArray[np.float64]) -> Triangles:
    """Returns triangles rotated by a matrix (3, 3) and then moved by a vector (3,)."""
    return triangles @ rotation.T + position_m


def _sphere_points(radius_m: float) -> NDArray[np.float64]:
    rows = min(num_sides(radius_m) // 2, 64)
    polar_rad = np.linspace(0.0, np.pi, rows + 1)[1:-1]
    around_rad = np.arange(2 * rows) * (np.pi / rows)
    ring = np.stack([np.cos(around_rad), np.sin(around_rad)], axis=1)
    bands = [np.c_[np.sin(polar) * ring, np.full(len(ring), np.cos(polar))] for polar in polar_rad]
    return radius_m * np.concatenate([*bands, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
