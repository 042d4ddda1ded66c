"""Many bats in step as one Gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Episode, Rays, Sensing, Sonar
from apex_bat.experience import ACTION_MEMORY, NUM_ACTIONS, NUM_BINS, NUM_EARS
from apex_bat.simulation.arenas import Arena, load_arenas
from apex_bat.simulation.colony import Colony
from apex_bat.storage import State

RENDER_MODES = ("rgb_array", "human")

Observation = dict[str, NDArray[Any]]
Info = dict[str, Any]
ArenaLike = str | Path | Arena | Sequence[Arena]


class EchoFlightVector(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """Bats that fly in one world, with one ray cast and one echo computation a step.

    What a bat observes, does and earns is told at `EchoFlight`; here every array has a row for each bat. A bat's flight
    is the same, to the bit, alone and among others: `reset(seed=7)` gives bat i the stream of seed 7 + i.

    Autoreset modes (gymnasium.vector.AutoresetMode):

    | mode      | at the end of an episode                                                                             |
    |-----------|------------------------------------------------------------------------------------------------------|
    | NEXT_STEP | the next step ignores that bat's action and returns its first observation with reward 0; the default |
    | SAME_STEP | the step returns the first observation of the next; the last is in `info["final_obs"]`, with the     |
    |           | last info in `info["final_info"]`; costs a second ray cast                                           |
    | DISABLED  | the caller resets with `reset(options={"reset_mask": mask})` before the next step                    |
    """

    def __init__(
        self,
        num_envs: int = 1,
        arena: ArenaLike = "simple",
        condition: str = "memory",
        *,
        body: Body | None = None,
        rays: Rays | None = None,
        sonar: Sonar | None = None,
        sensing: Sensing | None = None,
        episode: Episode | None = None,
        evaluation: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        """Builds the world.

        Args:
            num_envs: how many bats fly.
            arena: a name (see apex_bat.simulation.arenas), a path, or arenas, of which each episode draws one.
            condition: memory, no_memory or onset.
            body: the robot; None: the default, and so on.
            rays: the range sensors.
            sonar: call, air and ears.
            sensing: what becomes of echoes in the state.
            episode: reward and ends.
            evaluation: whether episodes end at contact or after `evaluation_steps`, and not by damage or idleness.
            autoreset_mode: see above.
            render_mode: `rgb_array`, `human` or None.

        Raises:
            ArenaError: the arena does not exist, is malformed or leaves no safe start.
            ValueError: another argument is not one of those allowed.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode is {render_mode!r}; it must be None or one of {', '.join(RENDER_MODES)}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self.num_envs = num_envs
        sensing = sensing or Sensing()
        self.single_observation_space = observation_space(sensing)
        self.single_action_space = spaces.Discrete(NUM_ACTIONS)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.colony = Colony(
            num_envs,
            find_arenas(arena, body, episode),
            condition,
            body=body,
            rays=rays,
            sonar=sonar,
            sensing=sensing,
            episode=episode,
            evaluation=evaluation,
            gui=render_mode == "human",
        )
        self._everyone = np.ones(num_envs, bool)
        self._has_begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Starts new episodes.

        Args:
            seed: an int seeds bat i with seed + i; a list gives each its own; None goes on with the streams there are.
            options: `reset_mask`, bool (bats,), says which bats; `poses`, float64 (bats, 3), gives start poses x, y,
                heading instead of random safe ones.
        """
        options = options or {}
        mask = self._mask(options.get("reset_mask"))
        for bat, number in enumerate(self._seeds(seed)):
            if number is not None and mask[bat]:
                self.colony.generators[bat] = np_random(number)[0]
        poses = options.get("poses")
        if poses is not None:
            poses = np.asarray(poses, np.float64)
            if poses.shape != (self.num_envs, 3) or not np.isfinite(poses).all():
                raise ValueError(f"options['poses'] must be finite, of shape ({self.num_envs}, 3), not {poses.shape}")
            poses = poses[mask]
        self.colony.begin(np.flatnonzero(mask), poses)
        self._has_begun = True
        return self.colony.observation(), self._info(mask)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Flies all bats one step of 50 ms; returns observation, rewards, terminations, truncations and info."""
        actions = self._checked(actions)
        colony = self.colony
        ended = np.flatnonzero(colony.end)
        if self.autoreset_mode == AutoresetMode.DISABLED and len(ended):
            raise ValueError(f"the episodes of bats {ended.tolist()} have ended; reset them with a reset_mask first")
        colony.step(actions, ended if self.autoreset_mode == AutoresetMode.NEXT_STEP else None)
        result = (colony.rewards.total, colony.terminated, colony.truncated)
        info: Info = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and colony.end.any():
            info = self._finish(colony.end != 0)
        info |= self._info(self._everyone)
        return colony.observation(), *result, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns a camera picture for each bat's arena, uint8 (height, width, 3); None unless `rgb_array`."""
        if self.render_mode != "rgb_array":
            return None
        pictures = {index: self.colony.world.picture(index) for index in set(self.colony.arena_index.tolist())}
        return tuple(pictures[index] for index in self.colony.arena_index.tolist())

    def state(self) -> State:
        """Returns all that the flights continue from, for `restore`; every bat must have been reset before.

        Raises:
            ValueError: there was no reset yet.
        """
        if not self._has_begun:
            raise ValueError("call reset before state")
        return self.colony.state()

    def restore(self, state: State) -> Observation:
        """Continues from what `state` of an environment with the same arguments returned; no reset is needed.

        What follows is what would have followed there, to the bit: observations, contacts, drawn arenas, noise.

        Returns:
            the observation that the last reset or step returned.

        Raises:
            ValueError: the state does not fit.
        """
        self.colony.restore(state)
        self._has_begun = True
        return self.colony.observation()

    def close_extras(self, **_: Any) -> None:
        """Closes the world."""
        self.colony.close()

    @property
    def arena(self) -> Arena:
        """The first arena, the only one unless several were given."""
        return self.colony.arenas[0]

    @property
    def arenas(self) -> tuple[Arena, ...]:
        """All arenas; `info["arena_index"]` says in which a bat is."""
        return self.colony.arenas

    @property
    def newest_frames(self) -> NDArray[np.float32]:
        """The frames heard last, after the condition onset was applied: float32 (bats, 2, 24)."""
        return self.colony.newest_frames

    @property
    def ranges_m(self) -> NDArray[np.float32]:
        """What the 3D sensor read last, inf for a miss: float32 (bats, points)."""
        return self.colony.ranges_m

    @property
    def ray_azimuth_rad(self) -> NDArray[np.float64]:
        """Azimuth of each ray of the 3D sensor, counter-clockwise from ahead: float64 (points,)."""
        return self.colony.sensors.azimuth_rad

    @property
    def ray_elevation_rad(self) -> NDArray[np.float64]:
        """Elevation of each ray of the 3D sensor: float64 (points,)."""
        return self.colony.sensors.elevation_rad

    @property
    def poses(self) -> NDArray[np.float64]:
        """Where the bats are: float64 (bats, 3), x, y in metres, heading in radians."""
        return self.colony.poses

    @property
    def clearance_m(self) -> NDArray[np.float64]:
        """The smallest reading of the 2D sensor, from the middle of the robot: float64 (bats,)."""
        return self.colony.clearance_m

    def _finish(self, ended: NDArray[np.bool_]) -> Info:
        """Starts new episodes of bats; returns what their last ones ended with."""
        last = self.colony.observation()
        observations = np.full(self.num_envs, None, dtype=object)
        for bat in np.flatnonzero(ended):
            observations[bat] = {key: values[bat] for key, values in last.items()}
        info = {"final_obs": observations, "final_info": self._info(ended)}
        self.colony.begin(np.flatnonzero(ended))
        return info | {"_final_obs": ended, "_final_info": ended}

    def _info(self, mask: NDArray[np.bool_]) -> Info:
        """Returns the info of all bats, with Gymnasium's masks that say for which it holds."""
        report = self.colony.report()
        return {**report, **{f"_{key}": mask for key in report}}

    def _seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            return [int(seed) + bat for bat in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds were given for {self.num_envs} bats; give one each")
        return seed

    def _mask(self, mask: object) -> NDArray[np.bool_]:
        if mask is None:
            return self._everyone
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            raise ValueError(f"options['reset_mask'] must be a bool array of shape ({self.num_envs},)")
        if not mask.any():
            raise ValueError("options['reset_mask'] must name at least one bat")
        if not self._has_begun and not mask.all():
            raise ValueError("the first reset must be of all bats: leave options['reset_mask'] out")
        return mask

    def _checked(self, actions: NDArray[np.int64]) -> NDArray[np.int64]:
        if not self._has_begun:
            raise ValueError("call reset before the first step")
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or not np.issubdtype(actions.dtype, np.integer):
            raise ValueError(
                f"actions must be integers of shape ({self.num_envs},), not {actions.dtype} {actions.shape}"
            )
        if actions.min() < 0 or actions.max() >= NUM_ACTIONS:
            raise ValueError(f"actions must be 0 (straight), 1 (left) or 2 (right), not {actions.tolist()}")
        return actions.astype(np.int64)


def observation_space(sensing: Sensing) -> spaces.Space[Any]:
    """Returns the space of one bat's state S_t (thesis eq. 3.2.1)."""
    rows = NUM_EARS * sensing.memory_steps
    return spaces.Dict(
        {
            "echoes": spaces.Box(-np.inf, np.inf, (rows, NUM_BINS), np.float32),
            "actions": spaces.MultiDiscrete([NUM_ACTIONS] * ACTION_MEMORY),
        }
    )


def find_arenas(arena: ArenaLike, body: Body | None, episode: Episode | None) -> tuple[Arena, ...]:
    """Returns the arenas that an argument stands for: names and paths are loaded."""
    if isinstance(arena, Arena):
        return (arena,)
    if isinstance(arena, (str, Path)):
        return load_arenas(arena, body=body, episode=episode)
    if not arena:
        raise ValueError("no arena was given")
    return tuple(arena)
