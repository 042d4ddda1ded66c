"""The robot's motion against closed forms."""

import numpy as np
import pytest

from apex_bat.config.settings import Body
from apex_bat.simulation.motion import (
    LEFT,
    RIGHT,
    STRAIGHT,
    TURN_SIGN,
    fly_arc,
    step_length_m,
    step_turn_rad,
    wrap_angle,
)


def test_a_step_is_15_cm_and_18_degrees() -> None:
    assert step_length_m(Body()) == pytest.approx(0.15)
    assert np.degrees(step_turn_rad(Body())) == pytest.approx(18.0)


def test_straight_flight_follows_the_heading() -> None:
    pose = fly_arc(np.array([[1.0, 2.0, np.pi / 6]]), np.zeros(1), np.array([0.5]))
    np.testing.assert_allclose(pose[0], [1.0 + 0.5 * np.cos(np.pi / 6), 2.25, np.pi / 6], atol=1e-15)


def test_quarter_turn_ends_a_radius_ahead_and_aside() -> None:
    radius_m = 0.7
    for side in (1.0, -1.0):
        pose = fly_arc(np.zeros((1, 3)), np.array([side * np.pi / 2]), np.array([radius_m * np.pi / 2]))
        np.testing.assert_allclose(pose[0], [radius_m, side * radius_m, side * np.pi / 2], atol=1e-12)


def test_twenty_left_steps_close_a_circle_of_the_thesis_radius() -> None:
    poses, corners = np.zeros((1, 3)), []
    for _ in range(20):
        poses = fly_arc(poses, TURN_SIGN[[LEFT]] * step_turn_rad(Body()), np.array([step_length_m(Body())]))
        corners.append(poses[0, :2])
    np.testing.assert_allclose(poses[0], 0.0, atol=1e-12)
    radius_m = np.hypot(*(np.array(corners) - (0.0, 3.0 / (2 * np.pi))).T)
    np.testing.assert_allclose(radius_m, 3.0 / (2 * np.pi), atol=1e-12)


def test_parts_of_an_arc_add_up_to_the_arc() -> None:
    generator = np.random.default_rng(5)
    poses, turn_rad, length_m = generator.normal(size=(50, 3)), generator.normal(size=50), generator.uniform(0, 2, 50)
    whole = fly_arc(poses, turn_rad, length_m)
    for _ in range(4):
        poses = fly_arc(poses, turn_rad / 4, length_m / 4)
    np.testing.assert_allclose(np.exp(1j * poses[:, 2]), np.exp(1j * whole[:, 2]), atol=1e-12)
    np.testing.assert_allclose(poses[:, :2], whole[:, :2], atol=1e-12)


def test_left_is_counter_clockwise_and_right_its_mirror_image() -> None:
    assert TURN_SIGN[STRAIGHT] == 0.0
    assert TURN_SIGN[LEFT] == -TURN_SIGN[RIGHT] == 1.0


def test_angles_are_wrapped_by_full_turns() -> None:
    np.testing.assert_allclose(wrap_angle(np.array([np.pi, 3.5 * np.pi, -0.5])), [-np.pi, -0.5 * np.pi, -0.5])
