"""Progress along centre lines against closed forms."""

import numpy as np
import pytest

from apex_bat.simulation.layout import Arena, Wall
from apex_bat.simulation.progress import centre_lines

WALL = Wall(0.0, 0.0, 0.0, 1.0, 0.1, 1.0)
SQUARE = Arena(start=(0.0, 0.0), walls=(WALL,), centre_line=((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)))
TRIANGLE = Arena(start=(0.0, 0.0), walls=(WALL,), centre_line=((0.0, 0.0), (3.0, 0.0), (0.0, 4.0)))
OPEN = Arena(start=(1.0, 1.0), walls=(WALL,))
FIRST = np.zeros(1, np.int64)


def test_place_is_the_arc_length_of_the_nearest_point() -> None:
    points = np.array([[1.0, 0.3], [4.2, 2.0], [3.0, 3.9], [-0.5, 1.0]])
    np.testing.assert_allclose(centre_lines([SQUARE]).locate(points, np.zeros(4, np.int64)), [1.0, 6.0, 9.0, 15.0])


def test_lines_of_different_arenas_keep_apart() -> None:
    lines = centre_lines([SQUARE, TRIANGLE, OPEN])
    np.testing.assert_allclose(lines.length_m, [16.0, 12.0, 0.0])
    np.testing.assert_allclose(lines.locate(np.array([[0.0, 2.0]] * 3), np.arange(3)), [14.0, 10.0, 0.0])


def test_advance_takes_the_shorter_way_round() -> None:
    lines = centre_lines([SQUARE])
    for before_m, after_m, expected_m in ((15.9, 0.2, 0.3), (0.2, 15.9, -0.3), (3.0, 3.15, 0.15)):
        assert lines.advance(np.array([before_m]), np.array([after_m]), FIRST)[0] == pytest.approx(expected_m)


def fly(points: np.ndarray) -> float:
    lines, progress_m = centre_lines([SQUARE]), np.zeros(1)
    place_m = lines.locate(points[:1], FIRST)
    for point in points[1:]:
        next_m = lines.locate(point[None], FIRST)
        progress_m += lines.advance(place_m, next_m, FIRST)
        place_m = next_m
    return float(lines.laps(progress_m, FIRST)[0])


def test_two_rounds_are_two_laps_and_backwards_minus_two() -> None:
    angle_rad = np.linspace(0.0, 4 * np.pi, 400)
    round_trip = 2.0 + 2.2 * np.c_[np.cos(angle_rad), np.sin(angle_rad)]
    assert fly(round_trip) == pytest.approx(2.0)
    assert fly(round_trip[::-1]) == pytest.approx(-2.0)


@pytest.mark.parametrize("middle", [(2.0, 0.0), (3.8, 0.2), (0.2, 2.0)])
def test_circling_on_the_spot_is_no_progress(middle: tuple[float, float]) -> None:
    angle_rad = np.linspace(0.0, 100 * np.pi, 1001)
    assert fly(np.array(middle) + 0.477 * np.c_[np.cos(angle_rad), np.sin(angle_rad)]) == pytest.approx(0.0, abs=1e-9)


def test_without_a_centre_line_there_is_no_progress() -> None:
    lines = centre_lines([OPEN])
    assert lines.advance(np.zeros(1), np.zeros(1), FIRST)[0] == pytest.approx(0.0)
    assert lines.laps(np.ones(1), FIRST)[0] == 0.0
