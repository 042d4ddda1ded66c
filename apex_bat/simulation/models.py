"""The surfaces of models: triangle meshes of the collision shapes in URDF files."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_bat.simulation.bullet import pybullet
from apex_bat.simulation.layout import ArenaError, Model
from apex_bat.simulation.meshes import (
    Triangles,
    box_mesh,
    capsule_mesh,
    cylinder_mesh,
    hull_mesh,
    place_mesh,
    sphere_mesh,
)


@cache
def model_parts(model: Model) -> tuple[Triangles, ...]:
    """Returns the closed surface of each collision shape of a model, in the arena's coordinates.

    Raises:
        ArenaError: the file cannot be loaded, has no collision shape, or one that is not convex.
    """
    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = load_model(client, model, (0.0, 0.0))
        parts = tuple(
            _collision_mesh(client, model, body, number, shape)
            for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client))
            for number, shape in enumerate(pybullet.getCollisionShapeData(body, link, physicsClientId=client))
        )
    finally:
        pybullet.disconnect(client)
    if not parts:
        raise ArenaError(f"{model.file}: the model has no collision shape, so that nothing would return an echo")
    return parts


def load_model(client: int, model: Model, offset_m: tuple[float, float]) -> int:
    """Returns the number of the fixed body that a model became in a PyBullet client, moved by an offset x, y."""
    position_m = (model.x_m + offset_m[0], model.y_m + offset_m[1], model.z_m)
    turn = (0.0, 0.0, math.sin(model.yaw_rad / 2), math.cos(model.yaw_rad / 2))
    try:
        body = pybullet.loadURDF(
            model.file,
            position_m,
            turn,
            useFixedBase=True,
            flags=pybullet.URDF_USE_IMPLICIT_CYLINDER,  # else cylinders become prisms of 32 sides
            physicsClientId=client,
        )
    except pybullet.error as error:
        raise ArenaError(f"{model.file}: PyBullet cannot load this model: {error}") from None
    return int(body)


def _collision_mesh(client: int, model: Model, body: int, number: int, shape: tuple[Any, ...]) -> Triangles:
    """Returns the surface of a collision shape, a row of getCollisionShapeData, in the arena's coordinates."""
    _, link, kind, size, _, position_m, turn = shape
    if kind == pybullet.GEOM_MESH:
        # PyBullet has scaled these corners and moved them to the link's frame already.
        data = pybullet.getMeshData(body, link, collisionShapeIndex=number, physicsClientId=client)
        if len(data[1]) < 4:
            raise ArenaError(f"{model.file}: a concave mesh; split it into convex ones")
        mesh = hull_mesh(np.array(data[1]))
    else:
        mesh = place_mesh(_primitive_mesh(model, kind, size), np.array(position_m, float), _rotation(turn))
    return place_mesh(mesh, *_link_frame(client, body, link))


def _primitive_mesh(model: Model, kind: int, size: tuple[float, ...]) -> Triangles:
    match kind:
        case pybullet.GEOM_BOX:
            return box_mesh(*size)
        case pybullet.GEOM_SPHERE:
            return sphere_mesh(size[0])
        case pybullet.GEOM_CYLINDER:
            return cylinder_mesh(size[1], size[0])
        case pybullet.GEOM_CAPSULE:
            return capsule_mesh(size[1], size[0])
    raise ArenaError(
        f"{model.file}: a collision shape of PyBullet's kind {kind}; use boxes, spheres, cylinders, capsules or meshes"
    )


def _link_frame(client: int, body: int, link: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if link < 0:
        position_m, turn = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    else:
        position_m, turn = pybullet.getLinkState(body, link, physicsClientId=client)[:2]
    return np.array(position_m, float), _rotation(turn)


def _rotation(turn: object) -> NDArray[np.float64]:
    return np.array(pybullet.getMatrixFromQuaternion(turn), float).reshape(3, 3)
