"""Tianshou's DQN with double Q-learning, dueling streams, priorities and n-step returns: the nearest algorithm to ours.

It collects and learns by turns in one process. Tried and documented in docs/results/peers.md: optimiser, learning rate,
threads of torch, number of bats.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory, OptimizerFactory, RMSpropOptimizerFactory
from tianshou.data import Collector, PrioritizedVectorReplayBuffer
from tianshou.env import BaseVectorEnv, SubprocVectorEnv
from tianshou.trainer import OffPolicyTrainer, OffPolicyTrainerParams

from apex_bat.config import Config
from benchmarks.peers.environments import Swarm, flat_space, obvious
from benchmarks.peers.network import FlatDueling, named
from benchmarks.peers.terms import NUM_OBVIOUS, epsilon_at, terms, updates_of
from benchmarks.peers.training import Task

EPOCH_STEPS = 1600  # between looks whether the budget is spent


def train(task: Task) -> None:
    """Trains until the budget is spent."""
    chosen = task.settings()
    torch.set_num_threads(int(chosen["threads"]))
    torch.manual_seed(task.seed)
    np.random.seed(task.seed)  # noqa: NPY002  # Tianshou draws from the global generator
    config, replay, learner = task.config, task.config.replay, task.config.learner
    if task.environment == "registered":
        num_bats = int(chosen["bats"])
        env: Any = SwarmVectorEnv(Swarm(num_bats, config), task.seed)
    else:
        num_bats = NUM_OBVIOUS
        env = SubprocVectorEnv([lambda: obvious(config)] * num_bats)
        env.seed(task.seed)
    algorithm = _algorithm(config, chosen)
    buffer = PrioritizedVectorReplayBuffer(
        replay.capacity, num_bats, alpha=replay.alpha, beta=replay.beta, weight_norm=True
    )
    collector = Collector(algorithm, env, buffer, exploration_noise=True)
    collector.reset()
    task.notebook.begin()
    collector.collect(n_step=replay.min_size // num_bats * num_bats, random=True)

    def look(_epoch: int, env_steps: int) -> None:
        policy = algorithm.policy
        policy.set_eps_training(epsilon_at(env_steps))
        share = min(1.0, algorithm.num_updates / replay.anneal_updates)
        buffer.set_beta(replay.beta + share * (replay.beta_end - replay.beta))
        task.notebook.look(replay.min_size + env_steps, algorithm.num_updates, algorithm.parameters_by_name, act)

    def act(flat: NDArray[np.float32]) -> NDArray[np.int64]:
        with torch.no_grad():
            q, _ = algorithm.policy.model(flat)
        return np.asarray(q.argmax(dim=1), np.int64)

    trainer = OffPolicyTrainer(
        algorithm,
        OffPolicyTrainerParams(
            training_collector=collector, epoch_num_steps=EPOCH_STEPS, collection_step_num_env_steps=num_bats,
            update_step_num_gradient_steps_per_sample=updates_of(1, config), batch_size=learner.batch_size,
            training_fn=look, verbose=False, show_progress=False,
        ),
    )  # fmt: skip
    trainer.reset(reset_collectors=False)
    while not task.notebook.is_over:
        trainer.execute_epoch()
    env.close()


def _algorithm(config: Config, chosen: dict[str, float]) -> CountedDQN:
    learner = config.learner
    optimiser: OptimizerFactory = AdamOptimizerFactory(lr=chosen["learning_rate"], eps=learner.epsilon)
    if not chosen["adam"]:
        optimiser = RMSpropOptimizerFactory(
            lr=chosen["learning_rate"], alpha=learner.rmsprop_decay, eps=learner.epsilon,
            centered=learner.rmsprop_centred,
        )  # fmt: skip
    policy = DiscreteQLearningPolicy(
        model=Model(config), action_space=spaces.Discrete(3), observation_space=flat_space(config)
    )
    return CountedDQN(
        policy=policy, optim=optimiser, gamma=learner.discount, n_step_return_horizon=learner.num_step,
        target_update_freq=int(chosen["target_period"]), is_double=True,
    )  # fmt: skip


class Model(FlatDueling):
    """The dueling network with the arguments and results that Tianshou has models take and give."""

    def forward(self, obs: Any, state: Any = None, info: Any = None) -> Any:
        """Returns Q, (batch, 3), and the state of a recurrent network, which this is not."""
        del info
        return super().forward(torch.as_tensor(obs, dtype=torch.float32)), state


class CountedDQN(DQN[Any]):
    """Tianshou's DQN, which counts its updates and clips its gradients as all do."""

    num_updates = 0

    def _create_policy_optimizer(self, optim: OptimizerFactory) -> Any:
        return self._create_optimizer(self.policy, optim, max_grad_norm=terms().learner.gradient_clip)

    def _update_with_batch(self, batch: Any) -> Any:
        self.num_updates += 1
        return super()._update_with_batch(batch)

    def parameters_by_name(self) -> dict[str, NDArray[np.float32]]:
        """Returns the online network's parameters."""
        model = self.policy.model
        return named(model.features, model.advantage, model.value)


class SwarmVectorEnv(BaseVectorEnv):
    """Bats in one world as Tianshou's vectorised environment; its collector asks for the resets itself."""

    def __init__(self, swarm: Swarm, seed: int) -> None:
        # The base class would make a worker for each bat; what the collector uses of it is all here.
        self._swarm = swarm
        self._seed: int | None = seed  # for the first reset
        self.env_num, self.is_async, self.is_closed = swarm.num_bats, False, False

    def get_env_attr(self, key: str, id: Any = None) -> list[Any]:  # noqa: A002  # Tianshou's name
        """Returns an attribute of the environment of one bat, for each."""
        del id
        name = {"action_space": "single_action_space", "observation_space": "single_observation_space"}.get(key, key)
        return [getattr(self._swarm.env, name)] * self.env_num

    def reset(self, env_id: Any = None, **_: Any) -> tuple[NDArray[np.float32], NDArray[Any]]:
        """Begins the episodes of some bats, or of all."""
        rows = np.arange(self.env_num) if env_id is None else np.atleast_1d(env_id)
        seed, self._seed = self._seed, None
        return self._swarm.reset(rows, seed), np.array([{} for _ in rows])

    def step(self, action: Any, id: Any = None) -> Any:  # noqa: A002  # Tianshou's name
        """Flies a step of all bats; a part of them cannot fly alone."""
        if id is not None and len(id) != self.env_num:
            raise ValueError(f"{len(id)} of {self.env_num} bats cannot fly without the others")
        return *self._swarm.step(np.asarray(action)), np.array([{"env_id": row} for row in range(self.env_num)])

    def close(self) -> None:
        """Closes the world."""
        self._swarm.close()
        self.is_closed = True
