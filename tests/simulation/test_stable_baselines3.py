"""Stable-Baselines3 trains on the registered environment as it is."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation

import apex_bat.simulation
from apex_bat.config.settings import Episode, Rays

NUM_STEPS = 400
FEW, SHORT = Rays(num_azimuth=20, num_elevation=4, num_clearance=90), Episode(training_steps=30)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["MultiInputPolicy", "MlpPolicy"])
def test_its_dqn_trains_without_an_adapter_of_ours(policy: str) -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    apex_bat.simulation.register_environments()
    env: gymnasium.Env[Any, Any] = gymnasium.make("apex_bat/EchoFlight-v0", arena="simple", rays=FEW, episode=SHORT)
    if policy == "MlpPolicy":
        env = FlattenObservation(env)
    model = stable_baselines3.DQN(
        policy, env, learning_starts=100, buffer_size=1000, batch_size=16, train_freq=4, seed=0, device="cpu"
    )
    before = [weights.detach().clone() for weights in model.policy.parameters()]
    model.learn(NUM_STEPS)
    changed = [not weights.equal(old) for weights, old in zip(model.policy.q_net.parameters(), before, strict=False)]
    assert any(changed)
    assert all(bool(weights.isfinite().all()) for weights in model.policy.parameters())
    assert model.replay_buffer.pos == NUM_STEPS
    assert len(model.ep_info_buffer) > 5
    observation, _ = env.reset(seed=1)
    action, _ = model.predict(observation, deterministic=True)
    assert np.asarray(action).item() in (0, 1, 2)
    env.close()
