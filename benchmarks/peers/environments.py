"""The two environments of the contest, with flat observations: what all libraries take.

*registered* is `apex_bat/EchoFlight-v0` as Gymnasium makes it, many bats in one world. *obvious* is the same flight,
reward and ends with the rays and ears of `benchmarks.obvious_environment`: what one writes without apex_bat's work on
speed. A flat observation is float32 (147,): the six echo rows one after another, then the last three actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorObservationWrapper
from numpy.typing import NDArray

from apex_bat.config import Config
from apex_bat.experience import ACTION_MEMORY, NUM_BINS, NUM_EARS, States
from apex_bat.simulation.env import EchoFlight
from apex_bat.simulation.registration import ENVIRONMENT, register_environments
from apex_bat.simulation.vector import EchoFlightVector, Observation
from benchmarks.obvious_environment import ObviousEnvironment

Flat = NDArray[np.float32]


def flatten(observation: Observation) -> Flat:
    """Returns the observation of one bat, (values,), or of several, (bats, values), as flat float32."""
    echoes, actions = observation["echoes"], observation["actions"]
    lead = echoes.shape[:-2]
    return np.concatenate([echoes.reshape(*lead, -1), actions], axis=-1, dtype=np.float32)


def unflatten(flat: Flat) -> States:
    """Returns the states in flat observations (bats, values)."""
    echoes = flat[:, :-ACTION_MEMORY].reshape(len(flat), -1, NUM_BINS)
    return States(echoes, flat[:, -ACTION_MEMORY:].astype(np.uint8))


def flat_space(config: Config) -> spaces.Box:
    """Returns the space of one flat observation."""
    return spaces.Box(-np.inf, np.inf, (NUM_EARS * config.state_steps * NUM_BINS + ACTION_MEMORY,), np.float32)


class FlatVector(VectorObservationWrapper):  # in Gymnasium 1.2, which RLlib needs, it takes no parameters
    """Many bats whose observations are flat."""

    def __init__(self, env: VectorEnv[Observation, NDArray[np.int64], NDArray[Any]], config: Config) -> None:
        super().__init__(env)
        self.single_observation_space = flat_space(config)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, env.num_envs)

    def observations(self, observations: Observation) -> Flat:
        """Flattens the observations of all bats."""
        return flatten(observations)


class FlatEnv(gymnasium.ObservationWrapper[Flat, np.int64, Observation]):
    """One bat whose observation is flat."""

    def __init__(self, env: gymnasium.Env[Observation, np.int64], config: Config) -> None:
        super().__init__(env)
        self.observation_space = cast("spaces.Space[Flat]", flat_space(config))

    def observation(self, observation: Observation) -> Flat:
        """Flattens one observation."""
        return flatten(observation)


def registered(num_bats: int, config: Config, autoreset_mode: AutoresetMode) -> FlatVector:
    """Returns the registered environment with many bats in one world."""
    register_environments()
    env: VectorEnv[Any, Any, Any] = gymnasium.make_vec(
        ENVIRONMENT, num_bats, "vector_entry_point", **_settings(config), autoreset_mode=autoreset_mode
    )
    return FlatVector(env, config)


def obvious(config: Config) -> FlatEnv:
    """Returns the obvious environment, one bat.

    Raises:
        ValueError: the settings are not the defaults, which is all that the obvious way can simulate.
    """
    default = Config()
    if (config.body, config.rays, config.sonar) != (default.body, default.rays, default.sonar):
        raise ValueError("body, rays and sonar must have their defaults: the obvious environment knows nothing else")
    return FlatEnv(ObviousFlight(**_settings(config)), config)


class ObviousFlight(EchoFlight):
    """The registered environment whose rays and ears are computed the obvious way."""

    def __init__(self, arena: str, condition: str, **settings: Any) -> None:
        super().__init__(arena, condition, **settings)
        self._yardstick = ObviousEnvironment(self.arena, (0.0, 0.0, 0.0))
        colony: Any = self.colony
        colony.sensors, colony.ears = SimpleNamespace(measure=self._measure), SimpleNamespace(frames=self._frames)

    def close(self) -> None:
        """Closes both worlds."""
        self._yardstick.close()
        super().close()

    def _measure(self, poses: NDArray[np.float64], _arena: object) -> tuple[Flat, NDArray[np.float64]]:
        """Returns ranges (1, points) and clearance (1,); the only arena lies at the origin of its world."""
        yardstick = self._yardstick
        yardstick._pose = poses[0].copy()
        range_m = yardstick._ranges_m(yardstick._ahead)
        return range_m[None].astype(np.float32), np.array([yardstick._ranges_m(yardstick._around).min()])

    def _frames(self, range_m: Flat, _generators: object) -> Flat:
        """Returns the frame of both ears, (1, 2, 24)."""
        yardstick, heard_m = self._yardstick, range_m[0].astype(np.float64)
        heard = np.stack([yardstick._hear(heard_m, gain_db) for gain_db in yardstick._gain_db])
        return cast("Flat", heard[None].astype(np.float32))


def _settings(config: Config) -> dict[str, Any]:
    return {
        "arena": config.arena, "condition": config.condition, "body": config.body, "rays": config.rays,
        "sonar": config.sonar, "sensing": config.sensing, "episode": config.episode,
    }  # fmt: skip


class Swarm:
    """Many bats that begin anew at once when their episodes end, and whose last observations are not lost.

    What the libraries' own forms of many environments are made of; Gymnasium's same-step mode does the same, with an
    object array of last observations that would have to be taken apart again.
    """

    def __init__(self, num_bats: int, config: Config) -> None:
        self.env = registered(num_bats, config, AutoresetMode.DISABLED)
        self.num_bats = num_bats

    def reset(self, rows: Sequence[int] | NDArray[np.int64] | None = None, seed: int | None = None) -> Flat:
        """Begins the episodes of some bats, or of all; returns the observations of these."""
        mask = np.ones(self.num_bats, bool)
        if rows is not None:
            mask[:] = False
            mask[np.asarray(rows)] = True
        flat, _ = self.env.reset(seed=seed, options={"reset_mask": mask})
        return np.asarray(flat[mask], np.float32)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Flat, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Flies a step; returns observations, rewards, terminations and truncations of all bats."""
        flat, rewards, terminated, truncated, _ = self.env.step(actions)
        return flat, rewards, terminated, truncated

    @property
    def unwrapped(self) -> EchoFlightVector:
        """The environment itself."""
        return cast("EchoFlightVector", self.env.unwrapped)

    def close(self) -> None:
        """Closes the world."""
        self.env.close()
