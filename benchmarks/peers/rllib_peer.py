"""RLlib's DQN with double Q-learning, dueling streams, priorities and n-step returns; two environment runners.

Its new API stack, which is the one that is developed. Sampling and learning take turns: the algorithm asks all runners
for steps, waits for them, and learns. Tried and documented in docs/results/peers.md: optimiser, runners, length of the
fragments, threads of torch.
"""

from __future__ import annotations

import logging
import os
import tempfile
from typing import Any

import gymnasium
import numpy as np
import ray
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from ray.rllib.algorithms.dqn.dqn import DQNConfig
from ray.rllib.algorithms.dqn.torch.default_dqn_torch_rl_module import DefaultDQNTorchRLModule
from ray.rllib.algorithms.dqn.torch.dqn_torch_learner import DQNTorchLearner
from ray.rllib.core.columns import Columns
from ray.rllib.core.models.base import ENCODER_OUT
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.tune.registry import register_env
from torch import nn

from benchmarks.peers.environments import obvious, registered
from benchmarks.peers.network import Features, FlatDueling, named
from benchmarks.peers.terms import EPSILON_STEPS, EPSILONS, NUM_OBVIOUS, terms, updates_of
from benchmarks.peers.training import Task

OWN: dict[str, float] = {"runners": 2, "fragment": 4}
REPORT_STEPS = 500
"""Steps that the algorithm samples between two looks at the notebook; each look costs it a report of its own."""
STORE_BYTES = 200_000_000


def train(task: Task) -> None:
    """Trains until the budget is spent."""
    chosen = task.settings(OWN)
    torch.set_num_threads(int(chosen["threads"]))
    os.environ.update(HOME=str(task.folder), RAY_USAGE_STATS_ENABLED="0")
    ray.init(
        num_cpus=2, include_dashboard=False, _node_ip_address="127.0.0.1", object_store_memory=STORE_BYTES,
        _temp_dir=tempfile.gettempdir(), log_to_driver=False, logging_level=logging.ERROR,
    )  # fmt: skip
    register_env("registered", make_swarm)
    register_env("obvious", make_obvious)
    algorithm = _config(task, chosen).build_algo()
    updates = 0
    learners = algorithm.learner_group

    def counted(*arguments: Any, **named_arguments: Any) -> Any:
        nonlocal updates
        updates += 1
        return update(*arguments, **named_arguments)

    update, learners.update = learners.update, counted
    module = learners._learner.module["default_policy"].unwrapped()
    env_steps = 0
    task.notebook.begin()
    while not task.notebook.look(env_steps, updates, lambda: parameters_of(module), lambda flat: act(module, flat)):
        result = algorithm.train()
        env_steps = int(result["env_runners"]["num_env_steps_sampled_lifetime"])


def _config(task: Task, chosen: dict[str, float]) -> Any:
    """Returns RLlib's description of the training."""
    learner, replay = task.config.learner, task.config.replay
    runners, fragment = int(chosen["runners"]), int(chosen["fragment"])
    is_registered = task.environment == "registered"
    num_bats = (int(chosen["bats"]) if is_registered else NUM_OBVIOUS) // max(runners, 1)
    updates = updates_of(num_bats * max(runners, 1) * fragment, task.config)
    # RLlib reckons the steps of a round with one runner more than there are.
    counted_steps = fragment * num_bats * (runners + 1)
    return (
        DQNConfig()
        .environment(task.environment)
        .framework("torch")
        .env_runners(
            num_env_runners=runners, num_envs_per_env_runner=num_bats, rollout_fragment_length=fragment,
            gym_env_vectorize_mode="vector_entry_point" if is_registered else "sync",
        )
        .learners(num_learners=0)
        .training(
            lr=chosen["learning_rate"], gamma=learner.discount, n_step=learner.num_step, double_q=True, dueling=True,
            train_batch_size_per_learner=learner.batch_size, num_atoms=1, td_error_loss_fn="mse",
            target_network_update_freq=round(chosen["target_period"] / updates_of(1, task.config)),
            num_steps_sampled_before_learning_starts=replay.min_size, grad_clip=learner.gradient_clip,
            training_intensity=round(updates) * learner.batch_size / counted_steps,
            epsilon=[(0, EPSILONS[0]), (EPSILON_STEPS, EPSILONS[1])],
            replay_buffer_config={
                "type": "PrioritizedEpisodeReplayBuffer", "capacity": replay.capacity, "alpha": replay.alpha,
                "beta": replay.beta,
            },
            learner_class=DQNTorchLearner if chosen["adam"] else RMSpropLearner,
        )
        .rl_module(rl_module_spec=RLModuleSpec(module_class=Module))
        .reporting(min_sample_timesteps_per_iteration=REPORT_STEPS)
        .debugging(seed=task.seed, log_level="ERROR")
    )  # fmt: skip


def make_swarm(context: Any) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Returns the bats of one runner in one world."""
    return registered(int(context["num_envs"]), terms(), AutoresetMode.NEXT_STEP)


def make_obvious(_context: Any) -> gymnasium.Env[Any, Any]:
    """Returns one bat of the obvious environment."""
    return obvious(terms())


class Encoder(nn.Module):
    """The convolutions of all as RLlib's encoder."""

    def __init__(self, layers: Features) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Returns the features of the observations in a batch."""
        return {ENCODER_OUT: self.layers(batch[Columns.OBS])}


class Module(DefaultDQNTorchRLModule):
    """RLlib's dueling Q network with the layers of all."""

    def setup(self) -> None:
        """Makes RLlib's layers, then puts the others in their places."""
        super().setup()
        network = FlatDueling(terms())
        self.encoder, self.af, self.vf = Encoder(network.features), network.advantage, network.value


class RMSpropLearner(DQNTorchLearner):
    """RLlib's learner with the optimiser of all instead of Adam."""

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:
        """Registers the optimiser of a module."""
        parameters, learner = self.get_parameters(self._module[module_id]), terms().learner
        optimiser = torch.optim.RMSprop(
            parameters, alpha=learner.rmsprop_decay, eps=learner.epsilon, centered=learner.rmsprop_centred
        )
        self.register_optimizer(
            module_id=module_id, optimizer=optimiser, params=parameters, lr_or_lr_schedule=config.lr
        )


def parameters_of(module: Any) -> dict[str, NDArray[np.float32]]:
    """Returns the online network's parameters by apex_bat's names."""
    return named(module.encoder.layers, module.af, module.vf)


def act(module: Any, flat: NDArray[np.float32]) -> NDArray[np.int64]:
    """Returns RLlib's own greedy actions."""
    with torch.no_grad():
        return np.asarray(module.forward_inference({Columns.OBS: torch.from_numpy(flat)})[Columns.ACTIONS], np.int64)
