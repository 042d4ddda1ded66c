"""Recording of an actor's own episodes: every n-th of one of its bats, as the settings `recording` say."""

from __future__ import annotations

import logging
import threading
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import PolicyValues
from apex_bat.recording.flight import FlightFacts, FlightLog
from apex_bat.roles.plan import Assignment
from apex_bat.simulation.arenas import arena_names
from apex_bat.simulation.vector import EchoFlightVector, Info, Observation

_WRITER = "apex_bat.recording.keeping"
_log = logging.getLogger(__name__)


class EpisodeRecorder:
    """Follows the least exploring bat of an actor that `recording.actors` names; other actors record nothing."""

    def __init__(self, assignment: Assignment, env: EchoFlightVector, epsilons: NDArray[np.float64]) -> None:
        """Takes the actor's part of the run, its bats, and how much each of them explores."""
        self._assignment, self._env = assignment, env
        self.bat = int(epsilons.argmin())
        self._epsilon = float(epsilons[self.bat])
        settings = assignment.config.recording
        self._every = settings.every_episodes if assignment.role.number in settings.actors else 0
        self._names = arena_names(assignment.config.arena)
        self.episode = 0
        """Number of the present episode of that bat."""
        self._log: FlightLog | None = None
        self._row: dict[str, object] = {}
        self._is_prepared = False

    def begin(self, learner_step: int) -> None:
        """Starts to follow an episode if it is the turn of one."""
        if self._every == 0:
            return
        if learner_step > 0 and not self._is_prepared:
            self._prepare()
        if (self.episode + 1) % self._every:
            return
        config = self._assignment.config
        name = self._names[self._env.colony.arena_index[self.bat]]
        facts = FlightFacts(
            arena=name, condition=config.condition, kind="training", seed=config.seed,
            episode=self.episode, actor=self._assignment.role.number, epsilon=self._epsilon,
            checkpoint_step=learner_step, body=config.body,
        )  # fmt: skip
        self._log = FlightLog(facts, config.state_steps, config.recording.heavy_period_steps)

    def before(self, observation: Observation, values: PolicyValues, actions: NDArray[np.int64]) -> None:
        """Notes what the bat perceives and chooses."""
        if self._log is None:
            return
        env, bat = self._env, self.bat
        self._row = {
            "pose": env.poses[bat].copy(), "frame": env.newest_frames[bat].copy(),
            "state": observation["echoes"][bat], "q": values.q[bat], "value": float(values.value[bat, 0]),
            "advantage": values.advantage[bat], "action": int(actions[bat]), "ranges_m": env.ranges_m[bat].copy(),
        }  # fmt: skip

    def after(self, rewards: NDArray[np.float64], info: Info) -> None:
        """Notes what the action led to."""
        if self._log is None:
            return
        terms = ("reward_straight", "reward_near", "clearance_m", "progress_m", "distance_m")
        row = self._row | {name: float(info[name][self.bat]) for name in terms}
        reward, contact = float(rewards[self.bat]), bool(info["contact"][self.bat])
        self._log.append(**row, reward=reward, contact=contact)  # type: ignore[arg-type]

    def end(self, ended: NDArray[np.bool_], info: Info) -> None:
        """Writes the recording if the episode has ended."""
        if not ended[self.bat]:
            return
        self.episode += 1
        if self._log is None:
            return
        keep_flights = import_module(_WRITER).keep_flights
        flight = self._log.finish(self._env.poses[self.bat].copy(), str(info["end"][self.bat]))
        self._log = None
        try:
            keep_flights([flight], self._assignment.config, self._assignment.run, draw=False)
        except OSError as error:
            _log.error("no recording: %s", error)

    def _prepare(self) -> None:
        """Imports what writes recordings, 2 s of CPU, beside the flight and not before the learner has begun."""
        self._is_prepared = True
        threading.Thread(target=import_module, args=(_WRITER,), daemon=True).start()
