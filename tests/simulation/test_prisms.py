"""Which rays need not be cast, in closed form."""

import numpy as np
import pytest

from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena, Model, Pillar, Wall
from apex_bat.simulation.prisms import Prisms, level_reach

ARENA = Arena(start=(0.0, 0.0), walls=(Wall(2.0, 0.0, np.pi / 2, 4.0, 0.2, 1.0),), pillars=(Pillar(0, 3, 0.5, 1.0),))
PRISMS = Prisms(ground_plan([ARENA]), np.zeros((1, 2)), 1.0)
FIRST = np.zeros(1, np.int64)


def test_a_rising_ray_reaches_as_far_as_it_stays_below_the_top_and_its_range_is_the_hypotenuse() -> None:
    reach_m, stretch = level_reach(np.array([0.0, np.pi / 4, np.pi / 3]), rise_m=0.6, max_range_m=20.0)
    np.testing.assert_allclose(reach_m, [20.0, 0.6, 0.6 / np.sqrt(3.0)], rtol=1e-6)
    np.testing.assert_allclose(stretch, [1.0, np.sqrt(2.0), 2.0], rtol=1e-6)


def test_a_short_sensor_reaches_its_greatest_range_along_the_ray() -> None:
    reach_m, stretch = level_reach(np.array([np.pi / 3]), rise_m=10.0, max_range_m=2.0)
    np.testing.assert_allclose(reach_m * stretch, 2.0, rtol=1e-6)


@pytest.mark.parametrize("heading_rad", [0.0, 1.0, -2.0])
def test_rays_on_both_sides_of_each_bearing_are_cast(heading_rad: float) -> None:
    rays = PRISMS.nearest_rays(np.array([[0.0, 0.1, heading_rad]]), FIRST, 360)
    assert rays is not None
    towards_deg = np.degrees([0.0 - heading_rad, np.pi / 2 - heading_rad])
    away_deg = (rays.reshape(2, 2) - towards_deg + 180.0) % 360.0 - 180.0
    assert (np.abs(away_deg) < 1.0 + 1e-6).all()
    np.testing.assert_array_equal((rays[0, 2:] - rays[0, :2]) % 360, 1)


def test_as_many_rays_as_the_sensor_has_are_not_chosen() -> None:
    assert PRISMS.nearest_rays(np.zeros((1, 3)), FIRST, 4) is None
    assert PRISMS.nearest_rays(np.zeros((1, 3)), FIRST, 5) is not None


def test_only_upright_bodies_of_one_height_have_a_common_top() -> None:
    wall, pillar = ARENA.walls[0], ARENA.pillars[0]
    assert ARENA.top_m == 1.0
    assert Arena(start=(0.0, 0.0), walls=(wall,), pillars=(pillar._replace(height_m=0.9),)).top_m is None
    assert Arena(start=(0.0, 0.0), walls=(wall,), models=(Model("any.urdf", 0.0, 0.0, 0.0, 0.0),)).top_m is None
