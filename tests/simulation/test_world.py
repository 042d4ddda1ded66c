"""Contact, sliding and pictures of the PyBullet world."""

from pathlib import Path

import numpy as np
import pybullet
import pytest
from numpy.typing import NDArray

from apex_bat.config.settings import Body
from apex_bat.simulation.layout import Arena, Model, Pillar, Wall
from apex_bat.simulation.world import World

RADIUS_M = Body().diameter_m / 2
WALL = Arena(start=(0.0, 0.0), walls=(Wall(1.0, 0.0, np.pi / 2, 6.0, 0.15, 1.0),))
FACE_M = 1.0 - 0.075
CORNER = Arena(start=(0.0, 0.0), walls=(*WALL.walls, Wall(0.0, 1.0, 0.0, 6.0, 0.15, 1.0)))
PILLAR = Arena(start=(0.0, 0.0), pillars=(Pillar(1.0, 0.0, 0.4, 1.0),))


def fly(
    arena: Arena, pose: tuple[float, float, float], length_m: float = 0.15, body: Body | None = None, steps: int = 1
) -> tuple[NDArray[np.float64], bool]:
    poses, row = np.array([pose]), np.zeros(1, np.int64)
    with World([arena], body or Body(), 1) as world:
        for _ in range(steps):
            poses, contact = world.fly(row, poses, row, np.zeros(1), np.array([length_m]))
    return poses[0], bool(contact[0])


def test_free_flight_goes_the_whole_way_without_contact() -> None:
    pose, contact = fly(WALL, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(pose, [0.15, 0.0, 0.0])
    assert not contact


@pytest.mark.parametrize("gap_m", [0.001, 0.05, 0.149])
def test_robot_stops_with_its_side_at_the_wall(gap_m: float) -> None:
    pose, contact = fly(WALL, (FACE_M - RADIUS_M - gap_m, 0.0, 0.0))
    assert contact
    np.testing.assert_allclose(pose, [FACE_M - RADIUS_M, 0.0, 0.0], atol=1e-3)


def test_a_gap_of_a_millimetre_is_no_contact() -> None:
    pose, contact = fly(WALL, (FACE_M - RADIUS_M - 0.151, 0.0, 0.0))
    assert not contact
    assert pose[0] == pytest.approx(FACE_M - RADIUS_M - 0.001)


def test_robot_slides_along_a_wall() -> None:
    pose, contact = fly(WALL, (FACE_M - RADIUS_M, 0.0, np.pi / 4))
    assert contact
    np.testing.assert_allclose(pose, [FACE_M - RADIUS_M, 0.15 * np.sin(np.pi / 4), np.pi / 4], atol=1e-3)


def test_robot_stays_outside_a_pillar() -> None:
    pose, contact = fly(PILLAR, (0.35, 0.02, 0.0))
    assert contact
    assert np.hypot(pose[0] - 1.0, pose[1]) == pytest.approx(0.4 + RADIUS_M, abs=1e-3)


def test_corner_holds_the_robot_on_both_sides() -> None:
    pose, contact = fly(CORNER, (0.6, 0.6, np.pi / 4), steps=5)
    assert contact
    np.testing.assert_allclose(pose[:2], FACE_M - RADIUS_M, atol=2e-3)


def test_no_step_however_long_tunnels_through_a_wall() -> None:
    fast = Body(speed_m_s=30.0)
    pose, contact = fly(WALL, (0.0, 0.0, 0.1), length_m=1.5, body=fast)
    assert contact
    assert pose[0] <= FACE_M - RADIUS_M + 1e-3


def test_random_flight_never_enters_a_wall_for_long() -> None:
    generator, poses, row = np.random.default_rng(0), np.array([[0.0, 0.0, 0.0]]), np.zeros(1, np.int64)
    pen = Arena(
        start=(0.0, 0.0), walls=(*CORNER.walls, Wall(-1.0, 0, np.pi / 2, 6, 0.15, 1), Wall(0, -1.0, 0, 6, 0.15, 1))
    )
    with World([pen], Body(), 1) as world:
        for _ in range(300):
            turn_rad = generator.choice([-1.0, 0.0, 1.0], 1) * np.radians(18)
            poses, _ = world.fly(row, poses, row, turn_rad, np.array([0.15]))
            assert np.abs(poses[0, :2]).max() <= FACE_M - RADIUS_M + 1e-3


def test_bats_pass_through_each_other() -> None:
    rows, poses = np.arange(2), np.array([[0.0, 0.0, 0.0], [0.2, 0.0, np.pi]])
    with World([WALL], Body(), 2) as world:
        after, contact = world.fly(rows, poses, np.zeros(2, np.int64), np.zeros(2), np.full(2, 0.15))
    np.testing.assert_allclose(after[:, 0], [0.15, 0.05])
    assert not contact.any()


def test_arenas_side_by_side_have_their_own_walls() -> None:
    rows, poses = np.arange(2), np.array([[FACE_M - RADIUS_M - 0.05, 0.0, 0.0], [0.4, 0.0, 0.0]])
    with World([WALL, PILLAR], Body(), 2) as world:
        after, contact = world.fly(rows, poses, np.array([0, 1]), np.zeros(2), np.full(2, 0.15))
        assert np.abs(world.offsets_m[1] - world.offsets_m[0]).max() > 20.0
    assert contact.all()
    assert after[0, 0] == pytest.approx(FACE_M - RADIUS_M, abs=1e-3)
    assert np.hypot(after[1, 0] - 1.0, after[1, 1]) == pytest.approx(0.4 + RADIUS_M, abs=1e-3)


def test_low_model_that_no_level_ray_meets_still_stops_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "kerb.urdf"
    path.write_text(
        '<robot name="kerb"><link name="base"><collision><origin xyz="0 0 0.1"/>'
        '<geometry><box size="0.2 2 0.2"/></geometry></collision></link></robot>'
    )
    arena = Arena(start=(0.0, 0.0), models=(Model(str(path), 1.0, 0.0, 0.0, 0.0),))
    pose, contact = fly(arena, (0.68, 0.0, 0.0))
    assert contact
    assert pose[0] <= 0.9 - RADIUS_M + 2e-3


def test_picture_shows_the_bat_where_it_is() -> None:
    row = np.zeros(1, np.int64)
    with World([CORNER], Body(), 1) as world:
        pictures = []
        for x_m in (-1.0, 0.5):
            world.place(row, np.array([[x_m, 0.0, 0.0]]), row)
            pictures.append(world.picture(width=160, height=120))
    assert pictures[0].shape == (120, 160, 3)
    assert pictures[0].dtype == np.uint8
    orange = [np.argwhere((p[:, :, 0] > 1.8 * p[:, :, 2]) & (p[:, :, 0] > 60)) for p in pictures]
    assert all(len(pixels) > 5 for pixels in orange)
    assert orange[1][:, 1].mean() > orange[0][:, 1].mean() + 5, "east must be on the right"


def test_closing_ends_the_client_and_may_be_repeated() -> None:
    world = World([WALL], Body(), 1)
    world.close()
    world.close()
    assert not pybullet.isConnected(world.client)


def test_a_world_that_is_dropped_ends_its_client() -> None:
    world = World([WALL], Body(), 1)
    client = world.client
    del world
    assert not pybullet.isConnected(client)
