"""Greedy flights that judge a policy, and what is noted of each (thesis section 4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium.vector import AutoresetMode
from msgspec import Struct
from numpy.typing import NDArray

from apex_bat.agent.inference import PolicyValues
from apex_bat.config import Config
from apex_bat.experience import NUM_ACTIONS, States
from apex_bat.recording.flight import Flight, FlightFacts, FlightLog
from apex_bat.simulation.arenas import arena_names
from apex_bat.simulation.vector import EchoFlightVector

CLEARANCE_QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95)


class Pilot(Protocol):
    """What chooses the actions of all bats of an evaluation: a network, or one of apex_bat.evaluation.baselines."""

    def __call__(self, states: States, /) -> PolicyValues:
        """Returns the values of all bats' actions in these states; the action of the greatest q is flown."""


@runtime_checkable
class Sighted(Pilot, Protocol):
    """A pilot that perceives more than the states."""

    def look(self, env: EchoFlightVector) -> None:
        """Is shown the environment once, before the first call."""


class FlightRecord(Struct, frozen=True):
    """One flight of an evaluation."""

    condition: str
    arena: str
    """Name of the one arena, also where several were asked for together."""
    seed: int
    """Seed of the start poses."""
    flight: int
    """Number of the flight among those of this seed."""
    start: tuple[float, float, float]
    """x in m, y in m, heading in rad."""
    steps: int
    completed: bool
    """Whether it reached the time limit."""
    collided: bool
    """Whether it ended at a wall."""
    distance_m: float
    """Way flown."""
    progress_m: float
    """Net way along the corridor, either direction."""
    reward: float
    """Undiscounted return."""
    action_shares: tuple[float, float, float]
    """Shares of straight, left, right."""
    clearance_quantiles_m: tuple[float, ...]
    """Distance to the nearest wall: its 0, 5, 25, 50, 75 and 95 % quantiles over the flight."""


def fly(
    policy: Pilot,
    config: Config,
    arena: str,
    *,
    num_flights: int,
    seed: int,
    num_recorded: int = 0,
    checkpoint_step: int | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
) -> tuple[list[FlightRecord], list[Flight]]:
    """Flies all flights of one evaluation at once and returns their records, and the first few as recorded flights.

    Args:
        policy: gives Q values; the greatest is taken, without exploration. One that is `Sighted` is shown the world.
        config: the settings of the run that is judged.
        arena: where to fly.
        num_flights: how many; the same seed gives the same starts to every policy and condition.
        seed: seed of the start poses.
        num_recorded: how many of them to log whole.
        checkpoint_step: learner step of the policy, for the recordings.
        is_stopped: breaks the flights off, for a role that is told to end; nothing is returned then.
    """
    env = EchoFlightVector(
        num_flights, arena, config.condition, body=config.body, rays=config.rays, sonar=config.sonar,
        sensing=config.sensing, episode=config.episode, evaluation=True, autoreset_mode=AutoresetMode.DISABLED,
    )  # fmt: skip
    try:
        log = _Log(env, config, arena, seed, num_recorded, checkpoint_step)
        if isinstance(policy, Sighted):
            policy.look(env)
        observation, _ = env.reset(seed=seed)
        log.begin()
        flying = np.ones(num_flights, bool)
        while flying.any():
            if is_stopped():
                return [], []
            values = policy(
                States(observation["echoes"].astype(np.float32, copy=False), observation["actions"].astype(np.uint8))
            )
            actions = values.q.argmax(axis=1)
            log.before(observation, values, actions, flying)
            observation, rewards, terminated, truncated, info = env.step(actions)
            ended = flying & (terminated | truncated)
            log.after(rewards, info, flying, ended)
            flying &= ~ended
            if (terminated | truncated).any() and flying.any():
                # The bats that have ended fly on uncounted, so that the others keep their places in the batch.
                observation, _ = env.reset(options={"reset_mask": terminated | truncated})
        return log.records(), sorted(log.flights, key=lambda flight: (flight.facts.arena, flight.facts.episode))
    finally:
        env.close()


class _Log:
    """What is noted of the flights of one evaluation while they last."""

    def __init__(
        self, env: EchoFlightVector, config: Config, arena: str, seed: int, num_recorded: int, step: int | None
    ) -> None:
        self._env, self._config, self._seed = env, config, seed
        self._names, self._step, self._num_recorded = arena_names(arena), step, num_recorded
        n = env.num_envs
        self._steps = np.zeros(n, np.int64)
        self._rewards = np.zeros(n)
        self._actions = np.zeros((n, NUM_ACTIONS), np.int64)
        self._clearance: list[list[float]] = [[] for _ in range(n)]
        self._last: list[dict[str, Any]] = [{} for _ in range(n)]
        self._chosen = np.zeros(n, np.int64)
        self._logs: list[FlightLog] = []
        self._before: list[dict[str, Any]] = []
        self.flights: list[Flight] = []

    def begin(self) -> None:
        """Notes where the bats start."""
        self._starts = self._env.poses.copy()
        self._arenas = [self._names[index] for index in self._env.colony.arena_index]
        config = self._config
        self._logs = [
            FlightLog(
                FlightFacts(arena=self._arenas[i], condition=config.condition, seed=self._seed, episode=i,
                            checkpoint_step=self._step, body=config.body),
                config.state_steps, config.recording.heavy_period_steps,
            )
            for i in range(min(self._num_recorded, len(self._starts)))
        ]  # fmt: skip

    def before(
        self,
        observation: dict[str, NDArray[np.generic]],
        values: PolicyValues,
        actions: NDArray[np.int64],
        flying: NDArray[np.bool_],
    ) -> None:
        """Notes what the bats perceive and choose."""
        self._chosen = actions
        env = self._env
        self._before = [
            {
                "pose": env.poses[i].copy(), "frame": env.newest_frames[i].copy(), "state": observation["echoes"][i],
                "q": values.q[i], "value": float(values.value[i, 0]), "advantage": values.advantage[i],
                "action": int(actions[i]), "ranges_m": env.ranges_m[i].copy(),
            }
            for i in range(len(self._logs))
            if flying[i]
        ]  # fmt: skip

    def after(
        self,
        rewards: NDArray[np.float64],
        info: dict[str, NDArray[np.generic]],
        flying: NDArray[np.bool_],
        ended: NDArray[np.bool_],
    ) -> None:
        """Notes what the actions led to."""
        recorded = iter(self._before)
        for i in np.flatnonzero(flying):
            self._steps[i] += 1
            self._rewards[i] += rewards[i]
            self._actions[i, self._chosen[i]] += 1
            self._clearance[i].append(float(info["clearance_m"][i]))
            if i < len(self._logs):
                self._logs[i].append(
                    **next(recorded), reward=float(rewards[i]), contact=bool(info["contact"][i]),
                    reward_straight=float(info["reward_straight"][i]), reward_near=float(info["reward_near"][i]),
                    clearance_m=float(info["clearance_m"][i]), progress_m=float(info["progress_m"][i]),
                    distance_m=float(info["distance_m"][i]),
                )  # fmt: skip
            if ended[i]:
                self._last[i] = {name: values[i] for name, values in info.items()}
                if i < len(self._logs):
                    self.flights.append(self._logs[i].finish(self._env.poses[i].copy(), str(info["end"][i])))

    def records(self) -> list[FlightRecord]:
        """Returns the record of each flight."""
        return [self._record(i) for i in range(len(self._steps))]

    def _record(self, i: int) -> FlightRecord:
        last, steps = self._last[i], int(self._steps[i])
        shares = self._actions[i] / steps
        x_m, y_m, heading_rad = (float(value) for value in self._starts[i])
        return FlightRecord(
            condition=self._config.condition, arena=self._arenas[i], seed=self._seed, flight=i,
            start=(x_m, y_m, heading_rad), steps=steps, completed=last["end"] == "time", collided=bool(last["contact"]),
            distance_m=float(last["distance_m"]), progress_m=abs(float(last["progress_m"])),
            reward=float(self._rewards[i]), action_shares=(float(shares[0]), float(shares[1]), float(shares[2])),
            clearance_quantiles_m=tuple(float(q) for q in np.quantile(self._clearance[i], CLEARANCE_QUANTILES)),
        )  # fmt: skip


def score(records: Sequence[FlightRecord]) -> tuple[float, float]:
    """Returns what ranks policies: the share of completed flights, then the mean progress along the corridor in m."""
    completed = float(np.mean([record.completed for record in records]))
    return completed, float(np.mean([record.progress_m for record in records]))
