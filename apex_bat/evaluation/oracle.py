"""A pilot that sees the walls: the best that the task allows, as far as 1.8 m of foresight tell.

At each call it tries every sequence of three actions, held for 2, 4 and 6 steps, on the points that the lowest rays of
the 3D range sensor show, and flies the first action of the best. A sequence is the better, the longer it stays clear of
the points; among those that stay clear to their end, the one whose clearance is enough, whose turns are few and that
leads where it is free.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import PolicyValues
from apex_bat.experience import NUM_ACTIONS, States
from apex_bat.simulation.motion import STRAIGHT, TURN_SIGN, fly_arc, step_length_m, step_turn_rad
from apex_bat.simulation.vector import EchoFlightVector

HELD_STEPS = (2, 4, 6)
"""How long each action of a sequence is held."""
MARGIN_M = 0.03
"""Kept beside the robot's radius: between two rays a wall is where neither saw it."""
ENOUGH_M = 0.5
"""Clearance above which more is worth nothing: a corridor of 1.2 m leaves 0.6."""
FAR_M = 1e3
"""Where the points of rays stand that hit nothing."""


class Oracle:
    """Plans on the range sensor's points; `look` must come before the first call."""

    def __init__(self) -> None:
        self._env: EchoFlightVector | None = None

    def look(self, env: EchoFlightVector) -> None:
        """Takes the environment whose range sensor it sees from now on."""
        self._env = env
        body = env.colony.body
        self._radius_m = body.diameter_m / 2
        self._rows = np.flatnonzero(np.isclose(env.ray_elevation_rad, env.ray_elevation_rad.min()))
        azimuth_rad = env.ray_azimuth_rad[self._rows]
        self._directions = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
        self._sequences, self._paths = _paths(step_turn_rad(body), step_length_m(body))

    def __call__(self, states: States) -> PolicyValues:
        """Returns as q the merit of the best sequence that begins with each action.

        Raises:
            RuntimeError: it was not shown an environment.
        """
        if self._env is None:
            raise RuntimeError("the oracle must look at an environment before it can fly")
        del states
        ranges_m = np.minimum(self._env.ranges_m[:, self._rows], FAR_M)
        merit = np.stack([self._merit(reach_m[:, None] * self._directions) for reach_m in ranges_m])
        first = self._sequences[:, 0]
        q = np.stack([merit[:, first == action].max(axis=1) for action in range(NUM_ACTIONS)], axis=1)
        return PolicyValues(q, q.max(axis=1, keepdims=True), q)

    def _merit(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Returns float32 (sequences,) for one bat, whose points (points, 2) lie ahead and to the left of it."""
        # |a - b|^2 = |a|^2 + |b|^2 - 2 a b: one matrix product, and what is the same for all points is added after it.
        places = self._paths.reshape(-1, 2)
        nearest = (np.square(points).sum(axis=1) - 2.0 * places @ points.T).min(axis=1)
        squared = np.maximum(nearest + np.square(places).sum(axis=1), 0.0)
        clearance_m = np.sqrt(squared).reshape(self._paths.shape[:2])
        is_clear = clearance_m > self._radius_m + MARGIN_M
        steps_clear = np.where(is_clear.all(axis=1), is_clear.shape[1], (~is_clear).argmax(axis=1))
        least_m = np.minimum(clearance_m.min(axis=1), ENOUGH_M)
        straight = (self._sequences == STRAIGHT) @ np.array(HELD_STEPS) / sum(HELD_STEPS)
        free_m = np.minimum(clearance_m[:, -1], 2 * ENOUGH_M)
        return np.asarray(steps_clear + 2.0 * least_m + 0.2 * straight + 0.2 * free_m, np.float32)


def _paths(turn_rad: float, length_m: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns the sequences, int64 (sequences, 3), and their places, float64 (sequences, steps, 2), from the origin."""
    sequences = np.array(list(product(range(NUM_ACTIONS), repeat=len(HELD_STEPS))))
    actions = np.repeat(sequences, HELD_STEPS, axis=1)
    poses, places = np.zeros((len(sequences), 3)), []
    for column in actions.T:
        poses = fly_arc(poses, TURN_SIGN[column] * turn_rad, np.full(len(poses), length_m))
        places.append(poses[:, :2])
    return sequences, np.stack(places, axis=1)
