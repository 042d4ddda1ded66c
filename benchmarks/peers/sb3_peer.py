"""Stable-Baselines3's DQN: n-step, without double Q-learning, dueling streams or priorities, which it does not have.

What was tried of its settings is in docs/results/peers.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from apex_bat.config import Config
from benchmarks.peers.environments import Swarm, obvious
from benchmarks.peers.network import Features, named, single_width
from benchmarks.peers.terms import EPSILON_STEPS, EPSILONS, NUM_OBVIOUS, updates_of
from benchmarks.peers.training import Task

NEVER = 100_000_000  # steps: the budget ends the training


def train(task: Task) -> None:
    """Trains until the budget is spent."""
    chosen = task.settings()
    torch.set_num_threads(int(chosen["threads"]))
    config = task.config
    num_bats = int(chosen["bats"]) if task.environment == "registered" else NUM_OBVIOUS
    env: VecEnv
    if task.environment == "registered":
        env = SwarmVecEnv(Swarm(num_bats, config), task.seed)
    else:
        env = SubprocVecEnv([lambda: obvious(config)] * num_bats, start_method="fork")  # else each imports torch again
        env.seed(task.seed)
    learner, replay = config.learner, config.replay
    optimiser: dict[str, Any] = {"optimizer_class": torch.optim.Adam, "optimizer_kwargs": {"eps": learner.epsilon}}
    if not chosen["adam"]:
        kwargs = {"alpha": learner.rmsprop_decay, "eps": learner.epsilon, "centered": learner.rmsprop_centred}
        optimiser = {"optimizer_class": torch.optim.RMSprop, "optimizer_kwargs": kwargs}
    model = DQN(
        "MlpPolicy", env, learning_rate=chosen["learning_rate"], buffer_size=replay.capacity,
        learning_starts=replay.min_size, batch_size=learner.batch_size, gamma=learner.discount, train_freq=1,
        gradient_steps=round(updates_of(num_bats, config)), n_steps=learner.num_step,
        target_update_interval=round(chosen["target_period"] / updates_of(1, config)),
        exploration_initial_eps=EPSILONS[0], exploration_final_eps=EPSILONS[1],
        exploration_fraction=EPSILON_STEPS / NEVER, max_grad_norm=learner.gradient_clip, seed=task.seed, device="cpu",
        policy_kwargs={
            "features_extractor_class": Extractor, "features_extractor_kwargs": {"config": config},
            "net_arch": [single_width(config)], **optimiser,
        },
    )  # fmt: skip
    task.notebook.begin()
    model.learn(NEVER, callback=NotebookCallback(task), log_interval=None)  # type: ignore[arg-type]
    env.close()


class Extractor(BaseFeaturesExtractor):
    """The convolutions of all as Stable-Baselines3's features."""

    def __init__(self, observation_space: Any, config: Config) -> None:
        layers = Features(config)
        super().__init__(observation_space, layers.width)
        self.layers = layers

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Returns the features of flat observations."""
        return torch.as_tensor(self.layers(observations))


class NotebookCallback(BaseCallback):
    """Looks at the notebook after each step of all bats, and ends the training with it."""

    def __init__(self, task: Task) -> None:
        super().__init__()
        self._task = task

    def _on_step(self) -> bool:
        model = cast("DQN", self.model)
        return not self._task.notebook.look(model.num_timesteps, model._n_updates, self._parameters, self._act)

    def _parameters(self) -> dict[str, NDArray[np.float32]]:
        network = cast("DQN", self.model).q_net
        return named(cast("Extractor", network.features_extractor).layers, network.q_net)

    def _act(self, flat: NDArray[np.float32]) -> NDArray[np.int64]:
        return np.asarray(self.model.predict(flat, deterministic=True)[0], np.int64)


class SwarmVecEnv(VecEnv):
    """Bats in one world as Stable-Baselines3's vectorised environment."""

    def __init__(self, swarm: Swarm, seed: int) -> None:
        self._swarm, self._seed = swarm, seed
        single = swarm.env
        super().__init__(swarm.num_bats, single.single_observation_space, single.single_action_space)
        self._actions = np.zeros(swarm.num_bats, np.int64)

    def reset(self) -> NDArray[np.float32]:
        """Begins the episodes of all bats."""
        return self._swarm.reset(seed=self._seed)

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Takes the actions of the next step."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> Any:
        """Flies the step; bats that ended are at the beginning of their next episode."""
        flat, rewards, terminated, truncated = self._swarm.step(self._actions)
        ended = np.flatnonzero(terminated | truncated)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in ended:
            infos[row] = {
                "terminal_observation": flat[row].copy(),
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        if len(ended):
            flat[ended] = self._swarm.reset(ended)
        return flat, rewards.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        """Closes the world."""
        self._swarm.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns an attribute of the environment, for each bat."""
        return [getattr(self._swarm.unwrapped, attr_name)] * len(self._rows(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Nothing can be set."""
        raise NotImplementedError(f"{attr_name} of bats {indices} cannot be set to {value}")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """No method can be called on single bats."""
        raise NotImplementedError(f"{method_name}{method_args}{method_kwargs} of bats {indices}")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Returns that no bat is wrapped."""
        del wrapper_class
        return [False] * len(self._rows(indices))

    def _rows(self, indices: Any) -> Sequence[int]:
        return [0] * self.num_envs if indices is None else np.atleast_1d(indices).tolist()
