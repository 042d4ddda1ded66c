"""Recording of an actor's own episodes: every n-th of its first bat, as `recording.every_episodes` says."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import PolicyValues
from apex_bat.recording.flight import FlightFacts, FlightLog
from apex_bat.roles.plan import Assignment
from apex_bat.simulation.vector import EchoFlightVector, Info, Observation

_log = logging.getLogger(__name__)
_BAT = 0


class EpisodeRecorder:
    """Follows the first bat of the first actor; other actors record nothing."""

    def __init__(self, assignment: Assignment, env: EchoFlightVector, epsilon: float) -> None:
        self._assignment, self._env, self._epsilon = assignment, env, epsilon
        every = assignment.config.recording.every_episodes
        self._every = every if assignment.role.number == 0 else 0
        self._episode = 0
        self._log: FlightLog | None = None
        self._row: dict[str, object] = {}

    def begin(self, learner_step: int) -> None:
        """Starts to follow an episode if it is the turn of one."""
        if self._every == 0 or self._episode % self._every:
            return
        config = self._assignment.config
        facts = FlightFacts(
            arena=self._env.arena.name, condition=config.condition, kind="training", seed=config.seed,
            episode=self._episode, actor=self._assignment.role.number, epsilon=self._epsilon,
            checkpoint_step=learner_step, body=config.body,
        )  # fmt: skip
        self._log = FlightLog(facts, config.state_steps, config.recording.heavy_period_steps)

    def before(self, observation: Observation, values: PolicyValues, action: int) -> None:
        """Notes what the bat perceives and chooses."""
        if self._log is None:
            return
        env = self._env
        self._row = {
            "pose": env.poses[_BAT].copy(), "frame": env.newest_frames[_BAT].copy(),
            "state": observation["echoes"][_BAT], "q": values.q[_BAT], "value": float(values.value[_BAT, 0]),
            "advantage": values.advantage[_BAT], "action": action, "ranges_m": env.ranges_m[_BAT].copy(),
        }  # fmt: skip

    def after(self, reward: float, info: Info) -> None:
        """Notes what the action led to."""
        if self._log is None:
            return
        terms = ("reward_straight", "reward_near", "clearance_m", "progress_m", "distance_m")
        row = self._row | {name: float(info[name][_BAT]) for name in terms}
        self._log.append(**row, reward=reward, contact=bool(info["contact"][_BAT]))  # type: ignore[arg-type]

    def end(self, ended: NDArray[np.bool_], info: Info) -> None:
        """Writes the recording if the episode has ended."""
        if not ended[_BAT]:
            return
        self._episode += 1
        if self._log is None:
            return
        from apex_bat.recording.keeping import keep_flights

        flight = self._log.finish(self._env.poses[_BAT].copy(), str(info["end"][_BAT]))
        self._log = None
        try:
            keep_flights([flight], self._assignment.config, self._assignment.run, draw=False)
        except OSError as error:
            _log.error("no recording: %s", error)
