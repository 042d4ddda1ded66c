"""Outlines of walls and arenas."""

from __future__ import annotations

import numpy as np
import pytest

from apex_bat.recording.outlines import arena_extent_m, model_triangles_m, wall_corners_m
from apex_bat.simulation.layout import Arena, Pillar, Wall


def test_corners_of_a_turned_wall() -> None:
    corners = wall_corners_m(Wall(1.0, 2.0, np.pi / 2, 4.0, 0.2, 1.0))
    np.testing.assert_allclose(corners, [(1.1, 0.0), (1.1, 4.0), (0.9, 4.0), (0.9, 0.0)], atol=1e-12)


def test_corners_run_counter_clockwise() -> None:
    x, y = wall_corners_m(Wall(1.0, 2.0, 0.7, 4.0, 0.2, 1.0)).T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert area == pytest.approx(0.8)


def test_extent_holds_walls_and_pillars() -> None:
    arena = Arena(start=(0, 0), walls=(Wall(0, 0, 0, 4.0, 0.2, 1.0),), pillars=(Pillar(3.0, 1.0, 0.5, 1.0),))
    assert arena_extent_m(arena) == pytest.approx((-2.0, 3.5, -0.1, 1.5))


def test_arena_without_models_has_no_triangles(room: Arena) -> None:
    assert model_triangles_m(room).shape == (0, 3, 3)
