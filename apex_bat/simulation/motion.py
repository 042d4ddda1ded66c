"""How the robot moves: pure functions of poses.

A pose is x, y in metres and the heading in radians, counter-clockwise from x. Within a step speed and turn rate are
constant, so that the path is an arc of a circle, or a straight line.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Body

STRAIGHT, LEFT, RIGHT = 0, 1, 2
TURN_SIGN = np.array([0.0, 1.0, -1.0])
"""Sign of the turn rate of each action; counter-clockwise, that is left, is positive."""


def step_length_m(body: Body) -> float:
    """Returns the length of the path of one step (thesis: 3 m/s for 50 ms = 0.15 m)."""
    return body.speed_m_s * body.call_interval_s


def step_turn_rad(body: Body) -> float:
    """Returns by how much the action left turns the robot in one step (thesis: 18 degrees)."""
    return math.radians(body.turn_rate_deg_s) * body.call_interval_s


def fly_arc(
    poses: NDArray[np.float64], turn_rad: NDArray[np.float64], length_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the poses at the end of arcs.

    The chord of an arc of length l that turns by a is l sin(a/2) / (a/2) long and points along heading + a/2; this is
    the exact solution for a unicycle, and a straight line where a = 0.

    Args:
        poses: float64 (bats, 3): x, y, heading.
        turn_rad: float64 (bats,), by how much each turns.
        length_m: float64 (bats,), length of each path.
    """
    half_rad = turn_rad / 2.0
    chord_m = length_m * np.sinc(half_rad / np.pi)  # numpy's sinc(x) is sin(pi x) / (pi x)
    # A contiguous copy: numpy may round sines of strided arrays differently, and then neighbours would matter.
    heading_rad = np.ascontiguousarray(poses[:, 2])
    middle_rad = heading_rad + half_rad
    return np.stack(
        [
            poses[:, 0] + chord_m * np.cos(middle_rad),
            poses[:, 1] + chord_m * np.sin(middle_rad),
            wrap_angle(heading_rad + turn_rad),
        ],
        axis=1,
    )


def wrap_angle(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns angles moved by full turns into -pi (included) to pi (excluded)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi
