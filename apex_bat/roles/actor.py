"""The actor: flies its bats in step, turns their flight into prioritized transitions and pushes them to the replay.

Every bat keeps its own epsilon of the ladder. First priorities come from the actor's own weights (Horgan et al. 2018,
algorithm 1), which are exchanged for newer ones every `actor.weights_period` steps.
"""

from __future__ import annotations

import logging
from contextlib import ExitStack, closing

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from apex_bat.agent.exploration import GREEDY_EPSILON, annealed, choose_actions, ladder_of_actor
from apex_bat.agent.inference import Policy, PolicyValues, initial_parameters, parameter_shapes
from apex_bat.agent.n_step import Accumulator
from apex_bat.experience import Chunk, States
from apex_bat.replay.client import TurnWriter
from apex_bat.roles import checkpoint
from apex_bat.roles.episodes import EpisodeRecorder
from apex_bat.roles.lines import ExperienceSink, WeightsSource
from apex_bat.roles.plan import Assignment
from apex_bat.roles.reporting import Phases, RoleReporter
from apex_bat.simulation.vector import EchoFlightVector, Observation
from apex_bat.storage import State, joined, part_of
from apex_bat.transport.weights import WeightsSubscriber

_log = logging.getLogger(__name__)
_WAIT_S = 0.2
_FLUSH_S = 1.0


def run_actor(assignment: Assignment) -> None:
    """Flies until told to stop."""
    config, addresses, keys = assignment.config, assignment.addresses, assignment.keys()
    shapes, most = parameter_shapes(config.network, config.state_steps), config.transport.max_message_bytes
    with ExitStack() as stack:
        weights = stack.enter_context(
            closing(
                WeightsSubscriber(
                    addresses.weights, shapes, keys=keys, generation=addresses.weights_generation,
                    max_message_bytes=most,
                )
            )
        )  # fmt: skip
        writer = stack.enter_context(
            closing(
                TurnWriter(
                    addresses.replays, assignment.role.name, config.actor.window_chunks, first=assignment.role.number,
                    keys=keys, generation=addresses.replay_generations,
                )
            )
        )  # fmt: skip
        reporter = stack.enter_context(closing(RoleReporter(assignment)))
        actor = stack.enter_context(closing(Actor(assignment, writer, weights, reporter)))
        while not assignment.stop.is_set():
            if (moved := assignment.moved()) is not None:
                writer.redirect(moved.replays, moved.replay_generations)
                weights.redirect(moved.weights, moved.weights_generation)
            if actor.is_ready(_WAIT_S):
                actor.step()
        actor.report("sending the last chunks")
        writer.flush(_FLUSH_S)


class Actor:
    """The state of one actor: bats, policy, accumulators."""

    def __init__(
        self, assignment: Assignment, writer: ExperienceSink, weights: WeightsSource, reporter: RoleReporter
    ) -> None:
        config, role = assignment.config, assignment.role
        self._config, self._writer, self._weights, self._reporter = config, writer, weights, reporter
        self._generator = assignment.generator()
        self._env = EchoFlightVector(
            config.bats_per_actor, config.arena, config.condition, body=config.body, rays=config.rays,
            sonar=config.sonar, sensing=config.sensing, episode=config.episode, autoreset_mode=AutoresetMode.DISABLED,
        )  # fmt: skip
        self._epsilons = ladder_of_actor(
            role.number % config.actors, config.actors, config.bats_per_actor, config.exploration
        )
        self._accumulators = [
            Accumulator(
                config.learner.num_step, config.learner.discount, config.state_steps, config.actor.chunk_transitions
            )
            for _ in range(config.bats_per_actor)
        ]
        self._policy = Policy(config.network, config.state_steps)
        self._begins_the_run = _begins_the_run(assignment)
        self._learner_step = -1
        self._parameters: dict[str, NDArray[np.float32]] = {}
        self._phases = Phases("simulation", "policy", "gathering", clock=assignment.clock)
        self._flown_before = assignment.flown_steps
        self._num_steps = 0
        self._has_begun = False
        self._observation: Observation
        self._values: PolicyValues
        self._frames: NDArray[np.float32]
        self._returns = np.zeros(config.bats_per_actor)
        self._recorder = EpisodeRecorder(assignment, self._env, self._epsilons)

    def is_ready(self, timeout_s: float) -> bool:
        """Says whether a step can be taken now; else waits for weights or for the replay, and reports for whom."""
        self._writer.poll(0.0)
        self._weights.wait(0.0)  # whoever is held back, or looks seldom, says so that it still wants what is new
        if self._learner_step < 0 and not (self._take_up_weights(timeout_s) or self._take_up_initial_weights()):
            return self._wait("waiting for the learner's weights")
        if not self._writer.has_room:
            self._writer.poll(timeout_s)
            if not self._writer.has_room:
                return self._wait(f"waiting for the replay server: {self._writer.waiting or 'no answer'}")
        if not self._has_begun:
            self._begin()
        return True

    def step(self) -> None:
        """Takes one step of all bats."""
        env, reporter = self._env, self._reporter
        actions = choose_actions(self._values.q, self._current_epsilons(), self._generator)
        self._recorder.before(self._observation, self._values, actions)
        with self._phases.of("simulation"):
            observation, rewards, terminated, truncated, info = env.step(actions)
        self._recorder.after(rewards, info)
        with self._phases.of("policy"):
            values = self._policy(_states(observation))
        ended = terminated | truncated
        with self._phases.of("gathering"):
            chunks = self._gather(actions, rewards, values, env.newest_frames, terminated, ended)
            if chunks:
                self._writer.send(chunks, self._learner_step)
        self._returns += rewards
        self._frames, self._observation, self._values = env.newest_frames.copy(), observation, values
        if ended.any():
            self._recorder.end(ended, info)
            self._end_episodes(ended)
        self._num_steps += 1
        reporter.count("env_steps", len(actions))
        if self._num_steps % self._config.actor.weights_period == 0:
            self._take_up_weights(0.0)
        if reporter.is_due:
            self.report("flying")

    def report(self, state: str) -> None:
        """Reports what the actor does, and its figures."""
        self._reporter.gauge("learner_step", self._learner_step)
        for name, value in self._writer.counters().items():
            self._reporter.gauge(name, value)
        self._reporter.send(state, self._phases)

    def state(self) -> State:
        """Returns all that the actor continues from, for `restore`; a recording in the making is not part of it."""
        values = {
            "learner_step": self._learner_step,
            "num_steps": self._num_steps,
            "has_begun": self._has_begun,
            "generator": self._generator.bit_generator.state,
            "episode": self._recorder.episode,
        }
        parts = {"self": State(values, {"returns": self._returns.copy()}), "reporter": self._reporter.state()}
        parts["parameters"] = State({}, dict(self._parameters))
        parts |= {f"accumulator-{bat}": each.state() for bat, each in enumerate(self._accumulators)}
        if self._has_begun:
            # The values are kept: some were computed in a smaller batch, which may round otherwise.
            parts |= {
                "env": self._env.state(),
                "values": State({}, {name: array.copy() for name, array in self._values._asdict().items()}),
            }
        return joined(parts)

    def restore(self, state: State) -> None:
        """Continues from what `state` of an actor with the same assignment returned.

        Raises:
            ValueError: the state does not fit.
        """
        values, arrays = part_of(state, "self")
        self._num_steps, self._has_begun = values["num_steps"], values["has_begun"]
        self._generator.bit_generator.state = values["generator"]
        self._recorder.episode = values["episode"]
        self._returns = arrays["returns"]
        self._reporter.restore(part_of(state, "reporter"))
        if values["learner_step"] >= 0:
            self._load(values["learner_step"], part_of(state, "parameters").arrays)
        for bat, accumulator in enumerate(self._accumulators):
            accumulator.restore(part_of(state, f"accumulator-{bat}"))
        if self._has_begun:
            self._observation = self._env.restore(part_of(state, "env"))
            self._values = PolicyValues(**part_of(state, "values").arrays)
            self._frames = self._env.newest_frames.copy()

    def close(self) -> None:
        """Closes the world."""
        self._env.close()

    def _begin(self) -> None:
        self._has_begun = True
        _log.info("begins to fly")
        observation, _ = self._env.reset(seed=int(self._generator.integers(2**31)))
        self._observation, self._values = observation, self._policy(_states(observation))
        self._frames = self._env.newest_frames.copy()
        self._recorder.begin(self._learner_step)

    def _current_epsilons(self) -> NDArray[np.float64]:
        if self._config.exploration.kind == "ladder":
            return self._epsilons
        # The other actors are taken to fly as fast as this one since it was started.
        steps = self._flown_before + self._num_steps * self._config.bats_per_actor * self._config.actors
        return np.full(self._config.bats_per_actor, annealed(steps, self._config.exploration))

    def _gather(
        self,
        actions: NDArray[np.int64],
        rewards: NDArray[np.float64],
        values: PolicyValues,
        next_frames: NDArray[np.float32],
        terminated: NDArray[np.bool_],
        ended: NDArray[np.bool_],
    ) -> list[Chunk]:
        q_taken = np.take_along_axis(self._values.q, actions[:, None], axis=1)[:, 0].tolist()
        next_q_max = values.q.max(axis=1).tolist()
        chunks = []
        for bat, accumulator in enumerate(self._accumulators):
            accumulator.step(self._frames[bat], int(actions[bat]), float(rewards[bat]), q_taken[bat], next_q_max[bat])
            if ended[bat]:
                chunk = accumulator.end(next_frames[bat], bool(terminated[bat]))
            else:
                chunk = accumulator.full_chunk(next_frames[bat])
            if chunk is not None:
                chunks.append(chunk)
        return chunks

    def _end_episodes(self, ended: NDArray[np.bool_]) -> None:
        epsilons = self._current_epsilons()
        for bat in np.flatnonzero(ended):
            self._reporter.count("episodes", 1)
            self._reporter.average("return", float(self._returns[bat]))
            if epsilons[bat] < GREEDY_EPSILON:
                self._reporter.average("return_greedy", float(self._returns[bat]))
        self._returns[ended] = 0.0
        observation, _ = self._env.reset(options={"reset_mask": ended})
        states = _states(observation)
        fresh = self._policy(States(states.echoes[ended], states.actions[ended]))
        for values, first in zip(self._values, fresh, strict=True):
            values[ended] = first
        self._observation, self._frames = observation, self._env.newest_frames.copy()
        if ended[self._recorder.bat]:
            self._recorder.begin(self._learner_step)

    def _take_up_weights(self, timeout_s: float) -> bool:
        if timeout_s > 0.0:
            self._weights.wait(timeout_s)
        weights = self._weights.newest()
        if weights is None:
            return False
        self._load(weights.learner_step, weights.arrays)
        return True

    def _take_up_initial_weights(self) -> bool:
        """Takes up what a learner broadcasts first, of which it is known what it is, while it still imports torch."""
        if not self._begins_the_run:
            return False
        config = self._config
        self._load(0, initial_parameters(config.network, config.state_steps, config.seed))
        return True

    def _load(self, learner_step: int, arrays: dict[str, NDArray[np.float32]]) -> None:
        self._policy.load(arrays)
        self._learner_step, self._parameters = learner_step, arrays

    def _wait(self, reason: str) -> bool:
        self._reporter.count("waits", 1)
        if self._reporter.is_due:
            self.report(reason)
        return False


def _begins_the_run(assignment: Assignment) -> bool:
    """Whether nothing was learnt yet when this actor was first started.

    One that joins late, or is started by hand, may have been told nothing of what the run has done; checkpoints tell.
    """
    is_first = assignment.incarnation == 0 and assignment.flown_steps == 0
    return is_first and not checkpoint.find(assignment.run / "checkpoints")


def _states(observation: Observation) -> States:
    return States(observation["echoes"].astype(np.float32, copy=False), observation["actions"].astype(np.uint8))
