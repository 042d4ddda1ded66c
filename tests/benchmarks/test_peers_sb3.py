"""Many bats in one world as Stable-Baselines3's vectorised environment; the other libraries are not installed here."""

from typing import Any

import numpy as np
import pytest

from apex_bat.config import load

pytest.importorskip("stable_baselines3")

from benchmarks.peers.environments import Swarm
from benchmarks.peers.sb3_peer import SwarmVecEnv


def test_a_bat_that_ends_begins_anew_and_its_last_observation_is_told() -> None:
    env = SwarmVecEnv(Swarm(2, load(None, ["episode.training_steps=5"])), seed=4)
    observation: Any = env.reset()
    assert observation.shape == (2, 147)
    for step in range(1, 6):
        observation, rewards, ended, infos = env.step(np.array([0, 1]))
        if step < 5:
            assert not ended.any()
    assert ended.all()
    assert rewards.shape == (2,)
    for row, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        assert info["terminal_observation"][-2:].tolist() == [row, row], "its last actions"
        assert not observation[row, : 4 * 24].any(), "silence before the next start"
    assert env.env_is_wrapped(object) == [False, False]
    env.close()
