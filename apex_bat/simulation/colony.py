"""A colony: bats that fly in step in one world, with one ray cast and one echo computation for all of them.

The core of both Gymnasium environments. Each bat has its own random generator and its row in every array; nothing of
one bat's flight depends on the others, to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.experience import ACTION_MEMORY
from apex_bat.simulation import scoring
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.motion import TURN_SIGN, step_length_m, step_turn_rad
from apex_bat.simulation.progress import centre_lines
from apex_bat.simulation.rays import make_sensors
from apex_bat.simulation.sensing import CONDITIONS, keep_onsets, silent_history, stack_echoes
from apex_bat.simulation.sonar import Sonar
from apex_bat.simulation.starts import start_region
from apex_bat.simulation.world import World
from apex_bat.storage import State

Rows = NDArray[np.int64]


class Colony:
    """State of `num_bats` episodes. Arrays have a row for each bat; read them, do not write them."""

    def __init__(
        self,
        num_bats: int,
        arenas: Sequence[Arena],
        condition: str = "memory",
        *,
        body: settings.Body | None = None,
        rays: settings.Rays | None = None,
        sonar: settings.Sonar | None = None,
        sensing: settings.Sensing | None = None,
        episode: settings.Episode | None = None,
        evaluation: bool = False,
        gui: bool = False,
    ) -> None:
        """Builds world, sensors and ears; every bat must `begin` before it can `step`.

        Args:
            num_bats: how many bats fly.
            arenas: one is drawn for each episode.
            condition: memory, no_memory or onset.
            body: the robot; None: the default, and so on.
            rays: the range sensors.
            sonar: call, air and ears.
            sensing: what becomes of echoes in the state.
            episode: reward and ends.
            evaluation: whether episodes end at contact or after `evaluation_steps`, instead of by damage, idleness or
                `training_steps`.
            gui: whether PyBullet shows its window.
        """
        if condition not in CONDITIONS:
            raise ValueError(f"condition is {condition!r}; it must be one of {', '.join(CONDITIONS)}")
        if num_bats < 1:
            raise ValueError(f"num_bats is {num_bats}; it must be at least 1")
        rays = rays or settings.Rays()
        self.arenas = tuple(arenas)
        self.condition = condition
        self.body = body or settings.Body()
        self.sensing = sensing or settings.Sensing()
        self.episode = episode or settings.Episode()
        self.evaluation = evaluation
        self._regions = [start_region(arena, self.body, self.episode) for arena in self.arenas]
        self._lines = centre_lines(self.arenas)
        self.world = World(self.arenas, self.body, num_bats, rays.max_range_m, gui)
        self.sensors = make_sensors(rays, self.body.sensor_height_m, self.world)
        self.ears = Sonar(sonar).listener(self.sensors.azimuth_rad, self.sensors.elevation_rad)
        self.generators = [np.random.default_rng() for _ in range(num_bats)]
        """One for each bat; the environments replace them when they are seeded."""
        self._make_state(num_bats)

    def _make_state(self, num_bats: int) -> None:
        self.arena_index = np.zeros(num_bats, np.int64)
        self.poses = np.zeros((num_bats, 3))
        self.steps = np.zeros(num_bats, np.int64)
        self.damage = np.zeros(num_bats, np.int64)
        self.idle = np.zeros(num_bats, np.int64)
        self.distance_m = np.zeros(num_bats)
        self.progress_m = np.zeros(num_bats)
        self.clearance_m = np.zeros(num_bats)
        self.contact = np.zeros(num_bats, bool)
        self.end = np.zeros(num_bats, np.int64)
        self.ranges_m = np.full((num_bats, len(self.sensors.azimuth_rad)), np.inf, np.float32)
        self.rewards = scoring.Rewards(np.zeros(num_bats), np.zeros(num_bats))
        self._place_m = np.zeros(num_bats)
        self._history = silent_history(num_bats, self.sensing)
        self._actions = np.zeros((num_bats, ACTION_MEMORY), np.int64)

    def begin(self, rows: Rows, poses: NDArray[np.float64] | None = None) -> None:
        """Starts new episodes at safe poses, or at given ones; their first echo is heard.

        Args:
            rows: int64 (n,), which bats.
            poses: float64 (n, 3), x, y, heading; None: each draws a safe start.
        """
        self._restart(rows, poses)
        self._hear(rows)

    def step(self, actions: NDArray[np.int64], restart: Rows | None = None) -> None:
        """Flies all bats one step, except some that start new episodes instead, and hears the next echoes.

        Args:
            actions: int64 (bats,).
            restart: int64 (n,), bats whose actions are ignored and whose episodes begin.
        """
        is_flying = np.ones(len(self.poses), bool)
        if restart is not None and len(restart):
            is_flying[restart] = False
            self._restart(restart, None)
        flying = np.flatnonzero(is_flying)
        if len(flying):
            self._fly(flying, actions[flying])
        self._hear(np.arange(len(self.poses)))
        self._score(flying, actions[flying])

    def observation(self) -> dict[str, NDArray[np.generic]]:
        """Returns the state S_t (thesis eq. 3.2.1), new arrays: echoes and the last three actions, oldest first."""
        actions = self._actions.copy() if self.sensing.action_memory else np.zeros_like(self._actions)
        return {"echoes": stack_echoes(self._history, self.condition), "actions": actions}

    @property
    def newest_frames(self) -> NDArray[np.float32]:
        """The frames heard last, after the condition onset was applied: float32 (bats, 2, 24)."""
        return self._history[:, -1].copy()

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """Which episodes have ended by damage, idleness or contact."""
        return scoring.TERMINATES[self.end]

    @property
    def truncated(self) -> NDArray[np.bool_]:
        """Which episodes have ended at the time limit."""
        return np.asarray(self.end == scoring.TIME)

    def report(self) -> dict[str, NDArray[np.generic]]:
        """Returns what is told in `info`, new arrays with a row for each bat; units are in the names."""
        return {
            "reward_straight": self.rewards.straight.copy(),
            "reward_near": self.rewards.near.copy(),
            "clearance_m": self.clearance_m.copy(),
            "distance_m": self.distance_m.copy(),
            "progress_m": self.progress_m.copy(),
            "laps": self._lines.laps(self.progress_m, self.arena_index),
            "contact": self.contact.copy(),
            "x_m": self.poses[:, 0].copy(),
            "y_m": self.poses[:, 1].copy(),
            "heading_rad": self.poses[:, 2].copy(),
            "steps": self.steps.copy(),
            "arena_index": self.arena_index.copy(),
            "end": scoring.ENDS[self.end],
        }

    def state(self) -> State:
        """Returns all that the flights continue from: poses, counters, memories, and the bats' random generators.

        World, sensors and ears add nothing: what they answer depends on the poses alone.
        """
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        return State({"generators": [generator.bit_generator.state for generator in self.generators]}, arrays)

    def restore(self, state: State) -> None:
        """Continues from what `state` returned: the next steps are those that would have followed, to the bit.

        Raises:
            ValueError: the state is of another number of bats, or of other rays or memory.
        """
        own = self._arrays()
        wrong = sorted(
            name
            for name in own.keys() | state.arrays.keys()
            if name not in own or name not in state.arrays or own[name].shape != state.arrays[name].shape
        )
        if wrong or len(state.values["generators"]) != len(self.generators):
            raise ValueError(f"the state is of other bats: {', '.join(wrong) or 'generators'} does not fit")
        for name, array in own.items():
            array[...] = state.arrays[name]
        for bat, numbers in enumerate(state.values["generators"]):
            self.generators[bat] = np.random.default_rng()  # a new one: two colonies must not share theirs
            self.generators[bat].bit_generator.state = numbers
        self.world.place(np.arange(len(self.poses)), self.poses, self.arena_index)

    def close(self) -> None:
        """Closes the world."""
        self.world.close()

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the arrays of all bats themselves, by name."""
        return {
            "arena_index": self.arena_index,
            "poses": self.poses,
            "steps": self.steps,
            "damage": self.damage,
            "idle": self.idle,
            "distance_m": self.distance_m,
            "progress_m": self.progress_m,
            "clearance_m": self.clearance_m,
            "contact": self.contact,
            "end": self.end,
            "ranges_m": self.ranges_m,
            "reward_straight": self.rewards.straight,
            "reward_near": self.rewards.near,
            "place_m": self._place_m,
            "history": self._history,
            "actions": self._actions,
        }

    def _restart(self, rows: Rows, poses: NDArray[np.float64] | None) -> None:
        if len(self.arenas) > 1:
            self.arena_index[rows] = [self.generators[row].integers(len(self.arenas)) for row in rows]
        if poses is None:
            poses = np.array([self._regions[self.arena_index[row]].sample(self.generators[row]) for row in rows])
        self.poses[rows] = poses
        for counter in (self.steps, self.damage, self.idle, self.distance_m, self.progress_m, self.end):
            counter[rows] = 0
        for term in self.rewards:
            term[rows] = 0.0
        self.contact[rows] = False
        self._history[rows] = 0.0
        self._actions[rows] = 0
        self._place_m[rows] = self._lines.locate(self.poses[rows, :2], self.arena_index[rows])
        self.world.place(rows, self.poses[rows], self.arena_index[rows])

    def _fly(self, rows: Rows, actions: NDArray[np.int64]) -> None:
        before, arena = self.poses[rows], self.arena_index[rows]
        turn_rad = TURN_SIGN[actions] * step_turn_rad(self.body)
        length_m = np.full(len(rows), step_length_m(self.body))
        if self.body.heading_noise_deg > 0.0:
            turn_rad = turn_rad + np.radians(self.body.heading_noise_deg) * self._noise(rows)
        if self.body.speed_noise > 0.0:
            length_m = length_m * np.maximum(1.0 + self.body.speed_noise * self._noise(rows), 0.0)
        after, contact = self.world.fly(rows, before, arena, turn_rad, length_m)
        moved_m = np.hypot(after[:, 0] - before[:, 0], after[:, 1] - before[:, 1])
        place_m = self._lines.locate(after[:, :2], arena)
        self.progress_m[rows] += self._lines.advance(self._place_m[rows], place_m, arena)
        self.distance_m[rows] += np.where(contact, moved_m, length_m)
        self.poses[rows], self.contact[rows], self._place_m[rows] = after, contact, place_m
        self.steps[rows] += 1
        self._actions[rows] = np.concatenate([self._actions[rows, 1:], actions[:, None]], axis=1)

    def _noise(self, rows: Rows) -> NDArray[np.float64]:
        return np.array([self.generators[row].standard_normal() for row in rows])

    def _hear(self, rows: Rows) -> None:
        poses, arena = self.poses[rows], self.arena_index[rows]
        poses[:, :2] += self.world.offsets_m[arena]
        range_m, self.clearance_m[rows] = self.sensors.measure(poses, arena)
        frames = self.ears.frames(range_m, [self.generators[row] for row in rows])
        if self.condition == "onset":
            frames = keep_onsets(frames, self.sensing)
        self.ranges_m[rows] = range_m
        self._history[rows, :-1] = self._history[rows, 1:]
        self._history[rows, -1] = frames

    def _score(self, rows: Rows, actions: NDArray[np.int64]) -> None:
        clearance_m = self.clearance_m[rows]
        rewards = scoring.score(clearance_m, actions, self.episode)
        for kept, term in zip(self.rewards, rewards, strict=True):
            kept[rows] = term
        self.damage[rows] = scoring.count_damage(self.damage[rows], clearance_m, self.episode)
        self.idle[rows] = scoring.count_idle(self.idle[rows], rewards.total)
        self.end[rows] = scoring.judge(
            self.steps[rows], self.damage[rows], self.idle[rows], self.contact[rows], self.episode, self.evaluation
        )
