"""Surfaces of URDF models lie where PyBullet's own solids are."""

from pathlib import Path

import numpy as np
import pybullet
import pytest

from apex_bat.config.settings import Body
from apex_bat.simulation.layout import Arena, ArenaError, Model
from apex_bat.simulation.models import model_parts
from apex_bat.simulation.rays import embree_caster
from apex_bat.simulation.world import World

INERTIA = (
    '<inertial><origin xyz="0.1 -0.2 0.3" rpy="0.1 0.2 0.3"/><mass value="1"/>'
    '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
)
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
SHAPES = {
    "box": '<box size="0.6 0.4 1"/>',
    "cylinder": '<cylinder radius="0.3" length="1"/>',
    "sphere": '<sphere radius="0.4"/>',
    "capsule": '<capsule radius="0.3" length="0.5"/>',
    "mesh": '<mesh filename="tetrahedron.obj" scale="0.9 0.8 1"/>',
}


def write(folder: Path, shape: str) -> Model:
    (folder / "tetrahedron.obj").write_text(TETRAHEDRON)
    place = '<origin xyz="0.1 0.2 0.4" rpy="0.2 0.1 0.5"/>'
    collision = f"<collision>{place}<geometry>{SHAPES[shape]}</geometry></collision>"
    joint = '<parent link="a"/><child link="b"/><origin xyz="1.5 0 0" rpy="0 0 1"/>'
    (folder / "model.urdf").write_text(
        f'<robot name="m"><link name="a">{INERTIA}{collision}</link><link name="b">{INERTIA}{collision}</link>'
        f'<joint name="j" type="fixed">{joint}</joint></robot>'
    )
    return Model(str(folder / "model.urdf"), 0.3, -0.4, 0.0, 0.8)


@pytest.mark.parametrize("shape", SHAPES)
def test_surface_is_met_where_a_small_ball_touches_the_solid(tmp_path: Path, shape: str) -> None:
    model = write(tmp_path, shape)
    assert len(model_parts(model)) == 2
    with World([Arena(start=(5.0, 5.0), models=(model,))], Body(), 0) as world:
        ball = pybullet.createMultiBody(
            0.0,
            pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=1e-4, physicsClientId=world.client),
            physicsClientId=world.client,
        )
        cast = embree_caster(world.triangles, 20.0)
        for part in model_parts(model):
            middle_m = part.mean(axis=(0, 1))
            for angle_rad in np.arange(6.0):
                ray = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.2]) / np.sqrt(1.04)
                origin_m = middle_m - 1.2 * ray
                range_m = float(cast(origin_m[None].astype(np.float32), ray[None].astype(np.float32))[0])
                pybullet.resetBasePositionAndOrientation(
                    ball, origin_m + range_m * ray, (0, 0, 0, 1), physicsClientId=world.client
                )
                solid = int(world.solids[0, 0])
                gaps_m = [
                    point[8] for point in pybullet.getClosestPoints(ball, solid, 1.0, physicsClientId=world.client)
                ]
                assert min(gaps_m) == pytest.approx(0.0, abs=3e-3)


def test_model_that_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    with pytest.raises(ArenaError, match=r"gone\.urdf: PyBullet cannot load"):
        model_parts(Model(str(tmp_path / "gone.urdf"), 0.0, 0.0, 0.0, 0.0))


def test_model_without_a_surface_is_refused(tmp_path: Path) -> None:
    ghost = tmp_path / "ghost.urdf"
    ghost.write_text('<robot name="ghost"><link name="base"/></robot>')
    with pytest.raises(ArenaError, match=r"ghost\.urdf: the model has no collision shape"):
        model_parts(Model(str(ghost), 0.0, 0.0, 0.0, 0.0))
