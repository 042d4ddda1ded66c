"""Pilots that learn nothing, flown through the same code as the network: what a result is to be measured against.

| name     | perceives         | does                                                                             |
|----------|-------------------|----------------------------------------------------------------------------------|
| random   | nothing           | draws each action                                                                |
| straight | nothing           | flies straight on                                                                |
| ild      | the newest echoes | turns away from the louder ear, by their level difference; Mansour et al. (2019)  |
| oracle   | the range sensor  | plans 1.8 m ahead among the points that it sees: what the task allows at best    |
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import PolicyValues
from apex_bat.config import Config, ConfigError
from apex_bat.evaluation.flights import Pilot
from apex_bat.evaluation.oracle import Oracle
from apex_bat.experience import NUM_ACTIONS, NUM_EARS, States
from apex_bat.simulation.motion import LEFT, RIGHT, STRAIGHT

ILD_BINS = 8
"""Milliseconds of echo, 17 cm each, in which levels are compared. Of 5, 8 and 24, 8 flew farthest in simple."""
ILD_THRESHOLD_DB = 2.0
"""Below this difference the ILD pilot flies straight. Of 0, 0.5, 1, 2, 3, 4, 6 and 9 dB, 2 completed most flights in
simple."""
QUIET = 1e-6
"""Added to the cochlea's output of a silent ear, so that its level is finite."""
COMPRESSION = 0.4
"""Exponent of the cochlea (Wiegrebe 2008), undone to get levels."""


class Straight:
    """Flies straight on."""

    def __call__(self, states: States) -> PolicyValues:
        """Returns values that are greatest for straight."""
        return values_of(np.full(len(states.echoes), STRAIGHT))


class Random:
    """Draws each action with the same chance."""

    def __init__(self, seed: int) -> None:
        self._generator = np.random.default_rng(seed)

    def __call__(self, states: States) -> PolicyValues:
        """Returns values that are greatest for a drawn action."""
        return values_of(self._generator.integers(NUM_ACTIONS, size=len(states.echoes)))


class LevelDifference:
    """Turns away from the ear that hears more of the near echoes: its whole sensing is one number.

    Mansour et al. (2019) fly by such a controller, which turns the more, the sooner the first echo comes. Here are only
    three actions; far echoes are left out instead, and where the ears differ little it flies straight.
    """

    def __init__(self, threshold_db: float = ILD_THRESHOLD_DB) -> None:
        self._threshold_db = threshold_db

    def __call__(self, states: States) -> PolicyValues:
        """Returns values that are greatest for the turn away from the louder ear."""
        return values_of(self.actions(level_difference_db(states)))

    def actions(self, difference_db: NDArray[np.float64]) -> NDArray[np.int64]:
        """Returns the action for each difference, left less right."""
        turns = np.where(difference_db > 0.0, RIGHT, LEFT)
        return np.where(np.abs(difference_db) < self._threshold_db, STRAIGHT, turns)


def level_difference_db(states: States) -> NDArray[np.float64]:
    """Returns by how much the near part of the newest frame is louder left than right: float64 (bats,) dB."""
    newest = states.echoes[:, -NUM_EARS:, :ILD_BINS].astype(np.float64).sum(axis=2) + QUIET
    return np.asarray(20.0 / COMPRESSION * np.log10(newest[:, 0] / newest[:, 1]))


def values_of(actions: NDArray[np.int64]) -> PolicyValues:
    """Returns values that are 1 for the given actions (bats,) and 0 for the others."""
    q = np.eye(NUM_ACTIONS, dtype=np.float32)[actions]
    return PolicyValues(q, q.max(axis=1, keepdims=True), q)


BASELINES: dict[str, Callable[[int], Pilot]] = {
    "random": Random,
    "straight": lambda _: Straight(),
    "ild": lambda _: LevelDifference(),
    "oracle": lambda _: Oracle(),
}
"""Name of each baseline, and what makes it from a seed."""


def make_baseline(name: str, config: Config) -> Pilot:
    """Returns a baseline by its name; its chance, if any, comes from the seed of the start poses.

    Raises:
        ConfigError: there is no such baseline.
    """
    if name not in BASELINES:
        raise ConfigError(f"--policy {name}: no such baseline; there are {', '.join(BASELINES)}")
    return BASELINES[name](config.evaluation.start_seed)
