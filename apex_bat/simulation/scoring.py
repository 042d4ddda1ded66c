"""Reward, counters and ends of an episode: pure functions of what happened (thesis eq. 3.2.2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Episode
from apex_bat.simulation.motion import STRAIGHT

ENDS = np.array(["", "damage", "idle", "contact", "time"])
"""Names of how an episode ends; the first stands for one that goes on."""
ON, DAMAGE, IDLE, CONTACT, TIME = range(5)
TERMINATES = np.array([False, True, True, True, False])
"""Which of them are terminations; the time limit is a truncation."""


class Rewards(NamedTuple):
    """The terms of the reward, float64 (bats,) each."""

    straight: NDArray[np.float64]
    """For flying straight and clear of walls."""
    near: NDArray[np.float64]
    """For being near a wall."""

    @property
    def total(self) -> NDArray[np.float64]:
        """The reward: the sum of its terms."""
        return self.straight + self.near


def score(clearance_m: NDArray[np.float64], actions: NDArray[np.int64], episode: Episode) -> Rewards:
    """Returns the reward of a step (thesis eq. 3.2.2); both terms are 0 where the clearance is exactly `near_m`.

    Args:
        clearance_m: float64 (bats,), after the step.
        actions: int64 (bats,), which action it was.
        episode: the reward's numbers.
    """
    is_far_and_straight = (clearance_m > episode.near_m) & (actions == STRAIGHT)
    return Rewards(
        np.where(is_far_and_straight, episode.straight_reward, 0.0),
        np.where(clearance_m < episode.near_m, episode.near_reward, 0.0),
    )


def count_damage(damage: NDArray[np.int64], clearance_m: NDArray[np.float64], episode: Episode) -> NDArray[np.int64]:
    """Returns the damage counters after a step: one more where the bat is near a wall."""
    return damage + (clearance_m < episode.near_m)


def count_idle(idle: NDArray[np.int64], reward: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns the idle counters after a step: one more for a negative reward, 0 again for a positive one."""
    return np.where(reward > 0.0, 0, idle + (reward < 0.0))


def judge(
    steps: NDArray[np.int64],
    damage: NDArray[np.int64],
    idle: NDArray[np.int64],
    contact: NDArray[np.bool_],
    episode: Episode,
    evaluation: bool,
) -> NDArray[np.int64]:
    """Returns how each episode ends, or that it goes on: int64 (bats,), an index of `ENDS`.

    In training damage and idleness terminate and `training_steps` truncates; in evaluation contact with a wall
    terminates and `evaluation_steps` truncates. A bat that terminates in its last step was not truncated.

    Args:
        steps: int64 (bats,), steps flown.
        damage: int64 (bats,), damage counters.
        idle: int64 (bats,), idle counters.
        contact: bool (bats,), which touched something in this step.
        episode: the limits.
        evaluation: which of the two sets of ends applies.
    """
    if evaluation:
        return np.where(contact, CONTACT, np.where(steps >= episode.evaluation_steps, TIME, ON))
    end = np.where(steps >= episode.training_steps, TIME, ON)
    end = np.where(idle > episode.max_idle, IDLE, end)
    return np.where(damage > episode.max_damage, DAMAGE, end)
