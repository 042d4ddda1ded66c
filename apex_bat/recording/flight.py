"""A flight as arrays, one row a step, and the log that gathers it while the bat flies.

Nothing here knows how a flight is stored or drawn, and nothing heavy is imported, so that actors may log every step.
Row k holds what the bat perceived and chose at its k-th call, and what that action led to by the next call: as in
Sutton and Barto, the reward of action k arrives at step k + 1. Poses have one row more, because the flight ends
somewhere.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import PureWindowsPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Condition
from apex_bat.config.settings import Recording as RecordingSettings
from apex_bat.experience import NUM_ACTIONS, NUM_BINS, NUM_EARS

Kind = Literal["training", "evaluation"]
Mark = Literal["", "best", "worst", "crash"]

ACTION_NAMES = ("straight", "left", "right")


@dataclass(frozen=True, kw_only=True)
class FlightFacts:
    """What is known of a flight before it starts."""

    arena: str
    """Name of the arena, as the settings give it."""
    condition: Condition
    """What the policy may use of the echoes."""
    kind: Kind = "evaluation"
    """Whether the flight trained the policy or judged it."""
    seed: int = 0
    """Seed of the start pose."""
    episode: int = 0
    """Number of the episode of this bat, or of the flight in its evaluation, from 0."""
    actor: int | None = None
    """Number of the actor; None: the evaluator."""
    epsilon: float = 0.0
    """Share of random actions."""
    checkpoint_step: int | None = None
    """Learner step of the weights that flew first; None: unknown or untrained."""
    mark: Mark = ""
    """Why the flight is kept longer than others; found out after it."""
    body: Body = field(default_factory=Body)
    """The robot: its size, sensor height and the time between two calls."""

    def file_name(self) -> str:
        """Returns a name for the recording that is unique in a run and allowed on every file system."""
        who = f"seed{self.seed}" if self.actor is None else f"actor{self.actor:03d}"
        weights = "" if self.checkpoint_step is None else f"-step{self.checkpoint_step}"
        arena = re.sub(r"[^A-Za-z0-9_]+", "_", PureWindowsPath(self.arena.removesuffix(".toml")).name)
        mark = f"-{self.mark}" if self.mark else ""
        return f"{self.kind}-{arena}-{self.condition}{weights}-{who}-{self.episode:06d}{mark}.rrd"


@dataclass(frozen=True, eq=False, kw_only=True)
class Flight:
    """A flown episode. Every array has one row a step, except `poses` (one more) and `ranges_m` (fewer)."""

    facts: FlightFacts
    """What was known before."""
    end: str
    """Why it ended: damage, idle, contact, time, or empty when it was broken off."""
    poses: NDArray[np.float64]
    """(steps + 1, 3): x in m, y in m, heading in rad at each call, and after the last action."""
    frame: NDArray[np.float32]
    """(steps, 2, 24): the echo frame heard at each call, left then right, as the condition leaves it."""
    state: NDArray[np.float32]
    """(steps, 2 * memory_steps, 24): what the network got, oldest left, oldest right, ..., newest right."""
    q: NDArray[np.float32]
    """(steps, 3): value of each action."""
    value: NDArray[np.float32]
    """(steps,): V of the dueling network."""
    advantage: NDArray[np.float32]
    """(steps, 3): A of the dueling network, before it is centred."""
    action: NDArray[np.uint8]
    """(steps,): the action chosen: 0 straight, 1 left, 2 right."""
    reward_straight: NDArray[np.float32]
    """(steps,): term of the reward for flying straight."""
    reward_near: NDArray[np.float32]
    """(steps,): term of the reward for coming near."""
    reward: NDArray[np.float32]
    """(steps,): the reward."""
    clearance_m: NDArray[np.float32]
    """(steps,): distance from the robot's centre to the nearest surface, after the action."""
    progress_m: NDArray[np.float32]
    """(steps,): way along the centre line since the start, after the action."""
    distance_m: NDArray[np.float32]
    """(steps,): distance flown since the start, after the action."""
    contact: NDArray[np.bool_]
    """(steps,): whether the action led into a wall."""
    heavy_period_steps: int
    """Row j of `ranges_m` belongs to step j * heavy_period_steps."""
    ranges_m: NDArray[np.float32] | None
    """(heavy rows, points): readings of the 3D range sensor, inf for a miss; None when they were not kept."""

    @property
    def num_steps(self) -> int:
        """Calls made."""
        return len(self.action)

    @property
    def heavy_steps(self) -> NDArray[np.int64]:
        """int64 (heavy rows,): steps whose ranges were kept."""
        rows = 0 if self.ranges_m is None else len(self.ranges_m)
        return np.arange(rows, dtype=np.int64) * self.heavy_period_steps

    @property
    def chosen_q(self) -> NDArray[np.float32]:
        """float32 (steps,): value of the action that was taken."""
        return self.q[np.arange(self.num_steps), self.action]

    @property
    def returns(self) -> NDArray[np.float64]:
        """float64 (steps,): undiscounted sum of the rewards so far."""
        return np.cumsum(self.reward, dtype=np.float64)

    @property
    def times_s(self) -> NDArray[np.float64]:
        """float64 (steps + 1,): time of each pose since the first call."""
        return np.arange(self.num_steps + 1, dtype=np.float64) * self.facts.body.call_interval_s


def row_dtype(memory_steps: int) -> np.dtype[np.void]:
    """The record of one step: the fields of `Flight` with one row a step, and the pose of the call."""
    return np.dtype(
        [
            ("pose", np.float64, 3),
            ("frame", np.float32, (NUM_EARS, NUM_BINS)),
            ("state", np.float32, (NUM_EARS * memory_steps, NUM_BINS)),
            ("q", np.float32, NUM_ACTIONS),
            ("value", np.float32),
            ("advantage", np.float32, NUM_ACTIONS),
            ("action", np.uint8),
            ("reward_straight", np.float32),
            ("reward_near", np.float32),
            ("reward", np.float32),
            ("clearance_m", np.float32),
            ("progress_m", np.float32),
            ("distance_m", np.float32),
            ("contact", np.bool_),
        ]
    )


class FlightLog:
    """Gathers a flight step by step; what is appended is copied, so that views of a batch may be given."""

    def __init__(
        self,
        facts: FlightFacts,
        memory_steps: int,
        heavy_period_steps: int = RecordingSettings().heavy_period_steps,
        max_steps: int = 256,
    ) -> None:
        """Makes room for a flight.

        Args:
            facts: what is known of the flight.
            memory_steps: echo frames in a state.
            heavy_period_steps: ranges are kept at every n-th step.
            max_steps: steps to make room for; more are taken all the same.
        """
        if heavy_period_steps < 1:
            raise ValueError(f"heavy_period_steps is {heavy_period_steps}; it must be at least 1")
        self.facts = facts
        self.num_steps = 0
        self._heavy_period_steps = heavy_period_steps
        self._rows = np.zeros(max_steps, row_dtype(memory_steps))
        self._ranges_m: list[NDArray[np.float32]] = []

    def append(
        self,
        *,
        pose: NDArray[np.float64],
        frame: NDArray[np.float32],
        state: NDArray[np.float32],
        q: NDArray[np.float32],
        value: float,
        advantage: NDArray[np.float32],
        action: int,
        reward_straight: float,
        reward_near: float,
        reward: float,
        clearance_m: float,
        progress_m: float,
        distance_m: float,
        contact: bool,
        ranges_m: NDArray[np.float32] | None = None,
    ) -> None:
        """Adds a step; shapes and meanings are those of a row of `Flight`, `pose` is that of the call.

        `ranges_m` float32 (points,) is given at every step or never; only every n-th is kept.
        """
        if self.num_steps == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self.num_steps] = (
            pose,
            frame,
            state,
            q,
            value,
            advantage,
            action,
            reward_straight,
            reward_near,
            reward,
            clearance_m,
            progress_m,
            distance_m,
            contact,
        )
        if ranges_m is not None and self.num_steps % self._heavy_period_steps == 0:
            self._ranges_m.append(np.array(ranges_m, np.float32))
        self.num_steps += 1

    def finish(self, last_pose: NDArray[np.float64], end: str) -> Flight:
        """Returns the flight.

        Args:
            last_pose: float64 (3,), pose after the last action.
            end: damage, idle, contact, time, or empty.

        Raises:
            ValueError: no step was appended, or ranges are missing at some steps.
        """
        if self.num_steps == 0:
            raise ValueError("a flight needs at least one step before it can finish")
        heavy_rows = math.ceil(self.num_steps / self._heavy_period_steps)
        if len(self._ranges_m) not in (0, heavy_rows):
            raise ValueError(
                f"ranges_m was given at {len(self._ranges_m)} of {heavy_rows} heavy steps; give all or none"
            )
        rows = self._rows[: self.num_steps]
        names = [name for name in rows.dtype.names or () if name != "pose"]
        return Flight(
            facts=self.facts,
            end=end,
            poses=np.concatenate([rows["pose"], np.asarray(last_pose, np.float64)[None]]),
            heavy_period_steps=self._heavy_period_steps,
            ranges_m=np.stack(self._ranges_m) if self._ranges_m else None,
            **{name: rows[name].copy() for name in names},
        )
