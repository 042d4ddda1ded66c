"""The range sensors against closed forms, and both casters against each other."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Episode, Rays
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena, Model, Pillar, Wall
from apex_bat.simulation.prisms import Prisms
from apex_bat.simulation.rays import (
    Caster,
    RangeSensors,
    directions,
    embree_caster,
    make_sensors,
    ray_angles,
)
from apex_bat.simulation.starts import start_region
from apex_bat.simulation.world import World

HEIGHT_M = Body().sensor_height_m
WALL = Arena(start=(0.0, 0.0), walls=(Wall(2.075, 0.0, np.pi / 2, 40.0, 0.15, 1.0),))
PILLAR = Arena(start=(0.0, 0.0), pillars=(Pillar(3.0, 0.0, 0.7, 1.0),))
SHAPES = """<robot name="shapes">
<link name="base">
<collision><origin xyz="0 0 0.5" rpy="0 0 0.3"/><geometry><box size="0.6 0.4 1"/></geometry></collision>
<collision><origin xyz="0.9 0 0.6" rpy="1.2 0 0"/><geometry><cylinder radius="0.2" length="1"/></geometry></collision>
</link>
<link name="ball"><collision><geometry><sphere radius="0.3"/></geometry></collision></link>
<joint name="j" type="fixed"><parent link="base"/><child link="ball"/><origin xyz="0 0.8 0.5" rpy="0.4 0.2 0.1"/>
</joint>
</robot>"""


CASTERS: tuple[Literal["embree", "pybullet"], ...] = ("embree", "pybullet")
ARENAS = ["simple", "narrow", "circle", "circuit", "maze", "corridor:1", "forest:1"]


def count_rays(caster: Caster) -> tuple[Caster, list[int]]:
    """Returns a caster, and a list that tells how many rays each of its calls had."""
    counts: list[int] = []

    def cast(origins: NDArray[np.float32], rays: NDArray[np.float32]) -> NDArray[np.float32]:
        counts.append(len(rays))
        return caster(origins, rays)

    return cast, counts


def sensors(arena: Arena, rays: Rays) -> RangeSensors:
    with World([arena], Body(), 0) as world:
        return RangeSensors(rays, HEIGHT_M, embree_caster(world.triangles, rays.max_range_m))


def test_default_layout_is_a_thousand_rays_over_a_half_circle_from_level_to_30_degrees() -> None:
    azimuth_rad, elevation_rad = ray_angles(Rays())
    assert azimuth_rad.shape == elevation_rad.shape == (1000,)
    np.testing.assert_allclose(np.degrees([azimuth_rad.min(), azimuth_rad.max()]), [-90.0, 90.0])
    np.testing.assert_allclose(np.unique(np.degrees(elevation_rad)), np.linspace(0.0, 30.0, 10))
    np.testing.assert_allclose(np.sort(azimuth_rad), np.sort(-azimuth_rad), err_msg="left and right must be alike")


def test_layout_follows_its_settings() -> None:
    azimuth_rad, elevation_rad = ray_angles(
        Rays(num_azimuth=4, num_elevation=2, azimuth_span_deg=360.0, max_elevation_deg=10.0)
    )
    np.testing.assert_allclose(np.degrees(azimuth_rad[:4]), [-180.0, -90.0, 0.0, 90.0])
    np.testing.assert_allclose(np.degrees(elevation_rad), [0, 0, 0, 0, 10, 10, 10, 10])
    np.testing.assert_array_equal(ray_angles(Rays(num_azimuth=1, num_elevation=1)), np.zeros((2, 1)))


def test_directions_are_forward_left_and_up() -> None:
    quarter = np.pi / 2
    rays = directions(np.array([0.0, quarter, 0.0]), np.array([0.0, 0.0, quarter]))
    np.testing.assert_allclose(rays, np.eye(3), atol=1e-15)


@pytest.mark.parametrize("heading_rad", [0.0, 0.4, -1.1, 3.0])
def test_range_to_a_wall_is_that_of_a_plane_and_rays_above_it_miss(heading_rad: float) -> None:
    sensor = sensors(WALL, Rays())
    range_m, clearance_m = sensor.measure(np.array([[0.5, 0.0, heading_rad]]))
    rays = directions(sensor.azimuth_rad + heading_rad, sensor.elevation_rad)
    expected_m = 1.5 / np.maximum(rays[:, 0], 1e-12)
    height_m = HEIGHT_M + expected_m * rays[:, 2]
    is_sure = (np.abs(height_m - 1.0) > 1e-3) & (np.abs(expected_m - 20.0) > 1e-2)
    expected_m[(height_m > 1.0) | (expected_m > 20.0)] = np.inf
    np.testing.assert_allclose(range_m[0][is_sure], expected_m[is_sure], rtol=1e-4)
    assert clearance_m[0] == pytest.approx(1.5, abs=1e-3)


def test_range_to_a_pillar_is_that_of_a_circle() -> None:
    range_m, clearance_m = sensors(PILLAR, Rays(num_elevation=1)).measure(np.zeros((1, 3)))
    azimuth_rad = ray_angles(Rays(num_elevation=1))[0]
    offset_m = 3.0 * np.sin(azimuth_rad)
    hits = (np.abs(offset_m) < 0.69) & (np.cos(azimuth_rad) > 0)
    expected_m = 3.0 * np.cos(azimuth_rad[hits]) - np.sqrt(0.49 - offset_m[hits] ** 2)
    np.testing.assert_allclose(range_m[0, hits], expected_m, atol=1e-3)
    assert np.isinf(range_m[0, np.abs(offset_m) > 0.71]).all()
    assert clearance_m[0] == pytest.approx(2.3, abs=1e-3)


def test_farther_than_the_greatest_range_is_a_miss() -> None:
    for rays, is_miss in ((Rays(max_range_m=1.4), True), (Rays(max_range_m=1.6), False)):
        range_m, clearance_m = sensors(WALL, rays).measure(np.array([[0.5, 0.0, 0.0]]))
        assert bool(np.isinf(range_m).all()) == is_miss
        assert bool(np.isinf(clearance_m[0])) == is_miss


def test_clearance_looks_all_around_whatever_the_heading() -> None:
    poses = np.array([[0.5, 0.0, heading_rad] for heading_rad in np.radians(np.arange(0, 360, 45))])
    _, clearance_m = sensors(WALL, Rays(num_azimuth=1, num_elevation=1)).measure(poses)
    np.testing.assert_allclose(clearance_m, 1.5, atol=1e-3)


@pytest.mark.parametrize("name", ARENAS)
def test_embree_and_pybullet_agree_within_a_millimetre_misses_included(name: str) -> None:
    arena, generator = load_arena(name), np.random.default_rng(11)
    region = start_region(arena, Body(), Episode())
    assert_casters_agree(arena, np.array([region.sample(generator) for _ in range(12)]))


@pytest.mark.parametrize("name", ARENAS)
def test_rays_that_are_left_out_read_what_they_would_have_read(name: str) -> None:
    arena, generator = load_arena(name), np.random.default_rng(12)
    corners = np.array(arena.corners())
    low, high = (*corners.min(axis=0), -np.pi), (*corners.max(axis=0), np.pi)
    poses = generator.uniform(low, high, (400, 3))
    poses = poses[ground_plan([arena]).clearance_m(poses[:, :2], np.zeros(400, np.int64)) > 0.1]
    with World([arena], Body(), 0) as world:
        few, cast = count_rays(embree_caster(world.triangles, 20.0))
        prisms = Prisms(world.ground, world.offsets_m, 1.0)
        range_m, clearance_m = RangeSensors(Rays(), HEIGHT_M, few, prisms).measure(poses)
        every, cast_all = count_rays(embree_caster(world.triangles, 20.0))
        full = RangeSensors(Rays(), HEIGHT_M, every)
        full_range_m, full_clearance_m = full.measure(poses)
    shorter_m = np.minimum(np.minimum(range_m, full_range_m), 20.0)
    at_the_top = np.abs(HEIGHT_M + shorter_m * np.sin(full.elevation_rad) - 1.0) < 1e-5
    np.testing.assert_allclose(range_m[~at_the_top], full_range_m[~at_the_top], atol=2e-4, rtol=0)
    np.testing.assert_allclose(clearance_m, full_clearance_m, atol=1e-4, rtol=0)
    assert at_the_top.mean() < 1e-3
    assert np.isinf(range_m).any()
    assert sum(cast) < sum(cast_all) / 5


def test_bats_of_several_arenas_get_the_rays_of_their_own() -> None:
    arenas = [load_arena("simple"), load_arena("circle"), load_arena("forest:1")]
    which, poses = np.array([0, 1, 2]), np.array([[*arena.start, 0.3] for arena in arenas])
    with World(arenas, Body(), 0) as world:
        poses[:, :2] += world.offsets_m
        together = make_sensors(Rays(), HEIGHT_M, world).measure(poses, which)
        full = RangeSensors(Rays(), HEIGHT_M, embree_caster(world.triangles, 20.0)).measure(poses)
    for k in range(2):
        np.testing.assert_allclose(together[k], full[k], atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("arena", "height_m"),
    [
        (
            Arena(start=(0.0, 0.0), walls=(Wall(2.0, 0.0, 0.3, 4.0, 0.15, 1.0), Wall(0.0, 2.0, 0.0, 4.0, 0.15, 0.7))),
            0.4,
        ),
        (PILLAR, 1.0),
    ],
    ids=["bodies of different heights", "a sensor as high as the bodies"],
)
def test_every_ray_is_cast_where_bodies_are_no_prisms_above_the_sensors(arena: Arena, height_m: float) -> None:
    with World([arena], Body(), 0) as world:
        measured = make_sensors(Rays(), height_m, world).measure(np.zeros((1, 3)))
        full = RangeSensors(Rays(), height_m, embree_caster(world.triangles, 20.0)).measure(np.zeros((1, 3)))
    for k in range(2):
        np.testing.assert_array_equal(measured[k], full[k])


def test_embree_and_pybullet_agree_on_a_users_model(tmp_path: Path) -> None:
    path = tmp_path / "shapes.urdf"
    path.write_text(SHAPES, encoding="utf-8")
    arena = Arena(start=(2.5, 0.0), models=(Model(str(path), 0.2, -0.3, 0.0, 0.5),))
    angle_rad = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    assert_casters_agree(arena, np.c_[3.0 * np.cos(angle_rad), 3.0 * np.sin(angle_rad), angle_rad + np.pi])


def assert_casters_agree(arena: Arena, poses: np.ndarray) -> None:
    with World([arena], Body(), 1) as world:
        world.place(np.zeros(1, np.int64), poses[:1], np.zeros(1, np.int64))
        world.show_bats()  # rays must pass through the bat's own body
        readings = [make_sensors(Rays(caster=caster), HEIGHT_M, world).measure(poses) for caster in CASTERS]
    (embree_m, embree_clearance_m), (pybullet_m, pybullet_clearance_m) = readings
    assert np.isfinite(embree_m).any()
    np.testing.assert_allclose(embree_m, pybullet_m, atol=1e-3, rtol=0)
    np.testing.assert_allclose(embree_clearance_m, pybullet_clearance_m, atol=1e-3, rtol=0)


def test_surface_of_a_users_model_lies_where_its_solids_are(tmp_path: Path) -> None:
    path = tmp_path / "ball.urdf"
    path.write_text(SHAPES, encoding="utf-8")
    model = Model(str(path), 0.2, -0.3, 0.0, 0.5)
    with World([Arena(start=(2.5, 0.0), models=(model,))], Body(), 0) as world:
        cast = embree_caster(world.triangles, 20.0)
        origins = np.array([[3.0, 3.0, 0.5]], np.float32)
        ball_m = np.array([0.2 - 0.8 * np.sin(0.5), -0.3 + 0.8 * np.cos(0.5), 0.5])
        towards = ball_m - origins
        distance_m = float(np.linalg.norm(towards))
        assert cast(origins, (towards / distance_m).astype(np.float32))[0] == pytest.approx(distance_m - 0.3, abs=2e-3)


def test_the_caster_is_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("apex_bat.simulation.rays.pybullet_caster", lambda client, _: asked.append(client))
    with World([WALL], Body(), 0) as world:
        make_sensors(Rays(), HEIGHT_M, world)
        assert not asked
        make_sensors(Rays(caster="pybullet"), HEIGHT_M, world)
        assert asked == [world.client]
