"""The PyBullet bodies of arenas and bats.

Everything fixed stands there twice: as solids, for contact and pictures, and as the triangles of their surfaces, for
rays. For Bullet's rays see its solids blurred: boxes by up to 2.6 mm, cylinders by 15 mm and convex meshes by 29 mm at
grazing incidence, while its contacts with triangles are off by centimetres (measured with PyBullet 3.2.7 in the shipped
arenas). Each is exact to micrometres on the other kind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Body
from apex_bat.simulation.bullet import pybullet
from apex_bat.simulation.layout import Arena, Pillar, Wall
from apex_bat.simulation.meshes import Triangles, box_mesh, cylinder_mesh, place_mesh
from apex_bat.simulation.models import load_model, model_parts

RAY_GROUP = 2
"""Collision group of what rays of PyBullet meet; the one that Bullet itself gives to fixed bodies."""
HIDDEN_GROUP = 64
"""Collision group of what they pass through: bats, and solids, whose surfaces stand there as triangles."""

RAY_TOLERANCE = 1e-4
"""Bullet lets a ray hit a triangle down to barycentric coordinates of minus this (its btTriangleRaycastCallback), up to
half a millimetre beyond the end of a wall. Triangles shrunk by as much are hit where the true ones would be."""

WALL_COLOUR = (0.75, 0.72, 0.66, 1.0)
PILLAR_COLOUR = (0.55, 0.62, 0.70, 1.0)
BAT_COLOUR = (0.85, 0.33, 0.10, 1.0)
NOSE_COLOUR = (0.10, 0.10, 0.10, 1.0)


def build_arena(client: int, arena: Arena, offset_m: NDArray[np.float64]) -> tuple[list[int], Triangles]:
    """Makes the fixed bodies of an arena, moved by an offset x, y.

    Returns:
        The number of the solid behind each footprint (walls, parts of models, pillars: the order of the ground plan),
        and the surfaces of all, float64 (triangles, 3, 3), moved by the offset.
    """
    shift = np.array([*offset_m, 0.0])
    solids = [_build_wall(client, wall, offset_m) for wall in arena.walls]
    surfaces = [wall_surface(wall) for wall in arena.walls]
    for model in arena.models:
        parts = model_parts(model)
        solids += [load_model(client, model, (float(offset_m[0]), float(offset_m[1])))] * len(parts)
        surfaces += parts
    for pillar in arena.pillars:
        solids.append(_build_pillar(client, pillar, offset_m))
        surfaces.append(pillar_surface(pillar))
    for solid in solids:
        _hide(client, solid)
    surface = np.concatenate(surfaces) + shift
    _build_surface(client, surface)
    return solids, surface


def build_bat(client: int, body: Body) -> int:
    """Returns the number of a new robot: a cylinder from the floor to the sensors, with a nose in front."""
    radius_m, height_m = body.diameter_m / 2, body.sensor_height_m
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_CYLINDER, radius=radius_m, height=height_m, physicsClientId=client
    )
    trunk = _colour(client, pybullet.GEOM_CYLINDER, BAT_COLOUR, radius=radius_m, length=height_m)
    nose = _colour(client, pybullet.GEOM_BOX, NOSE_COLOUR, halfExtents=(radius_m / 2, radius_m / 5, radius_m / 5))
    bat = pybullet.createMultiBody(
        0.0,
        shape,
        trunk,
        physicsClientId=client,
        linkMasses=[0.0],
        linkCollisionShapeIndices=[-1],
        linkVisualShapeIndices=[nose],
        linkPositions=[(radius_m / 2, 0.0, height_m / 2 + radius_m / 5)],
        linkOrientations=[(0.0, 0.0, 0.0, 1.0)],
        linkInertialFramePositions=[(0.0, 0.0, 0.0)],
        linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)],
        linkParentIndices=[0],
        linkJointTypes=[pybullet.JOINT_FIXED],
        linkJointAxis=[(0.0, 0.0, 1.0)],
    )
    _hide(client, bat)
    return int(bat)


def wall_surface(wall: Wall) -> Triangles:
    """Returns the surface of a wall in the arena's coordinates."""
    cosine, sine = math.cos(wall.yaw_rad), math.sin(wall.yaw_rad)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    box = box_mesh(wall.length_m, wall.thickness_m, wall.height_m)
    return place_mesh(box, np.array([wall.x_m, wall.y_m, wall.height_m / 2]), rotation)


def pillar_surface(pillar: Pillar) -> Triangles:
    """Returns the surface of a pillar in the arena's coordinates."""
    middle_m = np.array([pillar.x_m, pillar.y_m, pillar.height_m / 2])
    return np.asarray(cylinder_mesh(pillar.radius_m, pillar.height_m) + middle_m)


def _build_wall(client: int, wall: Wall, offset_m: NDArray[np.float64]) -> int:
    half = (wall.length_m / 2, wall.thickness_m / 2, wall.height_m / 2)
    shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
    colour = _colour(client, pybullet.GEOM_BOX, WALL_COLOUR, halfExtents=half)
    turn = (0.0, 0.0, math.sin(wall.yaw_rad / 2), math.cos(wall.yaw_rad / 2))
    place = (wall.x_m + offset_m[0], wall.y_m + offset_m[1], wall.height_m / 2)
    return int(pybullet.createMultiBody(0.0, shape, colour, place, turn, physicsClientId=client))


def _build_pillar(client: int, pillar: Pillar, offset_m: NDArray[np.float64]) -> int:
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_CYLINDER, radius=pillar.radius_m, height=pillar.height_m, physicsClientId=client
    )
    colour = _colour(client, pybullet.GEOM_CYLINDER, PILLAR_COLOUR, radius=pillar.radius_m, length=pillar.height_m)
    place = (pillar.x_m + offset_m[0], pillar.y_m + offset_m[1], pillar.height_m / 2)
    return int(pybullet.createMultiBody(0.0, shape, colour, place, physicsClientId=client))


def _build_surface(client: int, surface: Triangles) -> None:
    """Makes a body of triangles, met by rays and seen by no camera."""
    middle = surface.mean(axis=1, keepdims=True)
    shrunk = middle + (surface - middle) / (1.0 + 3.0 * RAY_TOLERANCE)
    corners: Sequence[Sequence[float]] = shrunk.reshape(-1, 3).tolist()
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH,
        vertices=corners,
        indices=list(range(len(corners))),
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        physicsClientId=client,
    )
    pybullet.createMultiBody(0.0, shape, physicsClientId=client)


def _hide(client: int, body: int) -> None:
    """Lets rays pass through all links of a body; asking for its closest points still works."""
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        pybullet.setCollisionFilterGroupMask(body, link, HIDDEN_GROUP, 0, physicsClientId=client)


def _colour(client: int, kind: int, colour: tuple[float, float, float, float], **size: object) -> int:
    return int(pybullet.createVisualShape(kind, rgbaColor=colour, physicsClientId=client, **size))
