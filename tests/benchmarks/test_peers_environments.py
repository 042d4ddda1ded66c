"""What the libraries of the contest fly: the registered environment with flat observations, and the obvious one."""

from collections.abc import Iterator

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from apex_bat.config import Config, load
from apex_bat.simulation.env import EchoFlight
from benchmarks.peers.environments import Swarm, flat_space, flatten, obvious, registered, unflatten

CONFIG = Config()
START = {"pose": (3.811 + 0.477, 0.0, np.pi / 2)}


def test_a_flat_observation_holds_rows_of_echoes_and_then_actions_and_is_taken_apart_again() -> None:
    echoes = np.arange(2 * 6 * 24, dtype=np.float32).reshape(2, 6, 24)
    actions = np.array([[0, 1, 2], [2, 2, 0]])
    flat = flatten({"echoes": echoes, "actions": actions})
    assert flat.shape == (2, *flat_space(CONFIG).shape)
    assert flat.dtype == np.float32
    assert flat[1, 24] == echoes[1, 1, 0]
    states = unflatten(flat)
    np.testing.assert_array_equal(states.echoes, echoes)
    np.testing.assert_array_equal(states.actions, actions)
    np.testing.assert_array_equal(flatten({"echoes": echoes[0], "actions": actions[0]}), flat[0])


def test_bats_of_the_registered_environment_fly_as_alone() -> None:
    many, alone = registered(2, CONFIG, AutoresetMode.NEXT_STEP), EchoFlight("simple", "memory")
    flat, _ = many.reset(seed=7)
    first, _ = alone.reset(seed=8)
    np.testing.assert_array_equal(flat[1], flatten(first))
    flat = many.step(np.array([0, 1]))[0]
    np.testing.assert_array_equal(flat[1], flatten(alone.step(np.int64(1))[0]))
    assert many.single_observation_space.contains(flat[0])
    many.close()
    alone.close()


def test_the_obvious_environment_is_the_same_flight() -> None:
    slow, fast = obvious(CONFIG), EchoFlight("simple", "memory")
    flat, _ = slow.reset(seed=1, options=START)
    exact, _ = fast.reset(seed=1, options=START)
    assert slow.observation_space.contains(flat)
    for action in (0, 1, 2, 0, 0, 1):
        differences = np.abs(flat - flatten(exact))
        assert (differences < 2e-3).mean() > 0.9
        assert differences.max() < 0.05, "where a delay is rounded the other way, a few values differ"
        flat, *told, info = slow.step(np.int64(action))
        exact, *expected, expected_info = fast.step(np.int64(action))
        assert told == expected
        assert info["clearance_m"] == pytest.approx(expected_info["clearance_m"], abs=1e-3)
    assert flat.any()
    slow.close()
    fast.close()


def test_the_obvious_environment_refuses_what_it_would_not_simulate() -> None:
    with pytest.raises(ValueError, match="defaults"):
        obvious(load(None, ["sonar.rendering=exact"]))


@pytest.fixture
def swarm() -> Iterator[Swarm]:
    made = Swarm(3, CONFIG)
    yield made
    made.close()


def test_some_bats_of_a_swarm_begin_anew_while_the_others_fly_on(swarm: Swarm) -> None:
    swarm.reset(seed=3)
    flat, rewards, terminated, truncated = swarm.step(np.array([1, 1, 1]))
    assert flat.shape == (3, 147)
    assert len(rewards) == len(terminated) == len(truncated) == 3
    fresh = swarm.reset([1])
    assert fresh.shape == (1, 147)
    assert swarm.unwrapped.colony.steps.tolist() == [1, 0, 1]
    assert not fresh[0, : 4 * 24].any(), "silence before the start"
