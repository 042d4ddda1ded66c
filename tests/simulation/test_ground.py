"""Distances to footprints against closed forms and a walk along their outlines."""

import numpy as np

from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena, Pillar, Wall

BOX = Arena(start=(5.0, 5.0), walls=(Wall(1.0, 2.0, 0.0, 4.0, 2.0, 1.0),))
ROUND = Arena(start=(5.0, 5.0), pillars=(Pillar(-1.0, 0.5, 0.5, 1.0),))


def distance_m(arena: Arena, points: list[tuple[float, float]]) -> np.ndarray:
    return ground_plan([arena]).clearance_m(np.array(points), np.zeros(len(points), np.int64))


def test_distance_to_a_wall_counts_from_its_faces_and_corners_and_is_negative_inside() -> None:
    points = [(1.0, 4.0), (6.0, 2.0), (6.0, 7.0), (1.0, 2.5), (-0.9, 2.0)]
    np.testing.assert_allclose(distance_m(BOX, points), [1.0, 3.0, 5.0, -0.5, -0.1], atol=1e-12)


def test_distance_to_a_pillar_counts_from_its_surface() -> None:
    np.testing.assert_allclose(distance_m(ROUND, [(-1.0, 2.0), (2.0, 4.5), (-1.0, 0.5)]), [1.0, 4.5, -0.5])


def test_distance_and_bearing_of_a_turned_wall_are_those_of_the_nearest_point_of_its_outline() -> None:
    wall = Wall(0.3, -0.2, 0.7, 3.0, 0.4, 1.0)
    share = np.linspace(-0.5, 0.5, 4001)
    ends, sides = np.full_like(share, 0.5), share
    local = np.concatenate([np.c_[sides, ends], np.c_[sides, -ends], np.c_[ends, sides], np.c_[-ends, sides]]) * (
        3.0,
        0.4,
    )
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    outline = local @ turn.T + (0.3, -0.2)
    points = [(2.0, 1.0), (-2.0, 0.3), (0.5, 1.5), (1.6, 0.9)]
    away = outline - np.array(points)[:, None]
    nearest = away[np.arange(4), np.hypot(away[..., 0], away[..., 1]).argmin(axis=1)]
    arena = Arena(start=(0, 0), walls=(wall,))
    np.testing.assert_allclose(distance_m(arena, points), np.hypot(*nearest.T), atol=1e-3)
    bearing_rad = ground_plan([arena]).bearing_rad(np.array(points), np.zeros(4, np.int64))
    np.testing.assert_allclose(bearing_rad[:, 0], np.arctan2(nearest[:, 1], nearest[:, 0]), atol=2e-3)


def test_bearing_of_a_pillar_is_that_of_its_middle() -> None:
    bearing_rad = ground_plan([ROUND]).bearing_rad(np.array([(-1.0, 2.0), (0.0, 1.5)]), np.zeros(2, np.int64))
    np.testing.assert_allclose(np.degrees(bearing_rad[:, 0]), [-90.0, -135.0])


def test_arenas_are_kept_apart() -> None:
    ground = ground_plan([BOX, ROUND])
    points = np.array([(1.0, 4.0), (1.0, 4.0)])
    np.testing.assert_allclose(ground.clearance_m(points, np.array([0, 1])), [1.0, np.hypot(2.0, 3.5) - 0.5])
