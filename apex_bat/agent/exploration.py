"""Epsilon-greedy exploration with one fixed epsilon a bat (Ape-X, Horgan et al. 2018, section 4.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Exploration

GREEDY_EPSILON = 0.01
"""Bats that explore less than this count as greedy when returns are reported."""


def ladder(num_bats: int, exploration: Exploration) -> NDArray[np.float64]:
    """Returns epsilon_i = base^(1 + alpha i / (N - 1)) of all N bats, float64 (num_bats,); one bat has `single`."""
    if num_bats == 1:
        return np.array([exploration.single])
    return exploration.base ** (1.0 + exploration.alpha * np.arange(num_bats) / (num_bats - 1))


def ladder_of_actor(actor: int, num_actors: int, num_bats: int, exploration: Exploration) -> NDArray[np.float64]:
    """Returns the epsilons of the bats of one actor, float64 (num_bats,).

    Bat b of actor a takes place b * num_actors + a of the ladder, so that every actor covers its whole height and
    the loss of one leaves no gap.
    """
    return ladder(num_actors * num_bats, exploration)[actor::num_actors]


def annealed(steps: int, exploration: Exploration) -> float:
    """Returns the epsilon of `anneal` after some steps of all bats together: linear from start to end."""
    done = min(1.0, steps / exploration.anneal_steps)
    return exploration.anneal_start + done * (exploration.anneal_end - exploration.anneal_start)


def choose_actions(
    q: NDArray[np.float32], epsilons: NDArray[np.float64], generator: np.random.Generator
) -> NDArray[np.int64]:
    """Returns the greedy action of each bat, or with its epsilon a uniformly drawn one, int64 (bats,)."""
    explore = generator.random(len(q)) < epsilons
    return np.where(explore, generator.integers(q.shape[1], size=len(q)), q.argmax(axis=1))
