"""What a training process writes down: a row of steps and updates at fixed intervals, each with the policy of then.

Judging comes afterwards and from these files: it costs nobody time, and everybody is judged in the same way. The clock
began when the process was started, so that importing a library and starting its workers count.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import Policy
from apex_bat.config import Config
from apex_bat.experience import ACTION_MEMORY, NUM_ACTIONS, NUM_BINS, NUM_EARS
from benchmarks.peers.environments import Flat, flatten, unflatten
from benchmarks.peers.judging import Parameters, fitting

FILE = "rows.jsonl"
NUM_SAMPLES, SAME = 64, 0.95
"""Made-up states in which a policy and its copy are compared, and the share of them in which they must choose the same:
rounding decides between actions that are worth the same."""


class Row(NamedTuple):
    """A moment of a training."""

    wall_s: float
    """Since the start of the process."""
    env_steps: int
    """Of all bats together."""
    updates: int
    policy: str = ""
    """Name of the file with the policy's parameters; empty if there is none."""


class Notebook:
    """Writes the rows of one training."""

    def __init__(
        self,
        folder: Path,
        config: Config,
        begin_s: float,
        budget_s: float,
        every_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Takes where and when to write.

        Args:
            folder: exists.
            config: the settings that all share.
            begin_s: when the process was started, by the clock.
            budget_s: when it is to end, in seconds after that.
            every_s: seconds between rows.
            clock: seconds, the same for all processes of the machine.
        """
        self._folder, self._config, self._clock = folder, config, clock
        self._begin_s, self._budget_s, self._every_s = begin_s, budget_s, every_s
        self._due_s, self._is_closed = every_s, False
        self._sample = _made_up_observations(config)

    def begin(self) -> None:
        """Writes that everything is made and the bats begin to fly."""
        append(self._folder, Row(round(self._clock() - self._begin_s, 3), 0, 0))

    @property
    def is_over(self) -> bool:
        """Whether the budget is spent."""
        return self._clock() - self._begin_s >= self._budget_s

    def look(
        self,
        env_steps: int,
        updates: int,
        parameters: Callable[[], Parameters],
        act: Callable[[Flat], NDArray[np.int64]],
    ) -> bool:
        """Writes a row if one is due, the last one when the budget is spent; returns whether it is.

        Args:
            env_steps: of all bats so far.
            updates: so far.
            parameters: returns the policy's parameters by the names of `apex_bat.agent.inference`.
            act: the library's own greedy actions for flat observations (n, values): the copy must choose the same.

        Raises:
            ValueError: the parameters are not those of the policy.
        """
        wall_s = self._clock() - self._begin_s
        is_over = wall_s >= self._budget_s
        if self._is_closed or (wall_s < self._due_s and not is_over):
            return is_over
        self._is_closed = is_over
        self._due_s = (wall_s // self._every_s + 1.0) * self._every_s
        arrays = parameters()
        self._verify(arrays, act)
        name = f"policy-{wall_s:09.3f}.npz"
        np.savez(self._folder / name, allow_pickle=False, **dict(arrays))
        append(self._folder, Row(round(wall_s, 3), env_steps, updates, name))
        return is_over

    def _verify(self, arrays: Mapping[str, NDArray[np.float32]], act: Callable[[Flat], NDArray[np.int64]]) -> None:
        copy = Policy(fitting(self._config.network, arrays), self._config.state_steps)
        copy.load(dict(arrays))
        chosen = copy(unflatten(self._sample)).q.argmax(axis=1)
        same = float((chosen == np.asarray(act(self._sample)).reshape(-1)).mean())
        if same < SAME:
            raise ValueError(f"the copied policy chooses as the library's in {same:.0%} of states only")


def append(folder: Path, row: Row) -> None:
    """Appends a row to a training's file."""
    with (folder / FILE).open("a", encoding="utf-8") as file:
        file.write(json.dumps(row._asdict()) + "\n")


def read(folder: Path) -> list[Row]:
    """Returns the rows that a training has written."""
    path = folder / FILE
    if not path.exists():
        return []
    return [Row(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def _made_up_observations(config: Config) -> Flat:
    """Returns flat observations whose values are about as large as those of echoes, float32 (n, values)."""
    generator, shape = np.random.default_rng(0), (NUM_SAMPLES, NUM_EARS * config.state_steps, NUM_BINS)
    actions = generator.integers(NUM_ACTIONS, size=(NUM_SAMPLES, ACTION_MEMORY))
    return flatten({"echoes": generator.gamma(0.5, 0.1, shape), "actions": actions})
