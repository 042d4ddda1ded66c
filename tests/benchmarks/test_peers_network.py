"""The network that all libraries of the contest train, and its parameters by apex_bat's names."""

import numpy as np
import pytest
import torch
from torch import nn

from apex_bat.agent.inference import Policy, parameter_shapes
from apex_bat.agent.network import DuelingNetwork
from apex_bat.config import Config
from benchmarks.peers.environments import flatten
from benchmarks.peers.judging import fitting
from benchmarks.peers.network import Features, FlatDueling, named, single_width

CONFIG = Config()
GENERATOR = np.random.default_rng(5)
ECHOES = GENERATOR.gamma(0.5, 0.1, (32, 6, 24)).astype(np.float32)
ACTIONS = GENERATOR.integers(3, size=(32, 3))
FLAT = flatten({"echoes": ECHOES, "actions": ACTIONS})


def test_the_flat_network_is_apex_bats_network() -> None:
    network, flat = DuelingNetwork(CONFIG.network, CONFIG.state_steps), FlatDueling(CONFIG)
    flat.features.filters.load_state_dict(network.filters.state_dict())
    flat.value.load_state_dict(network.value.state_dict())
    flat.advantage.load_state_dict(network.advantage.state_dict())
    expected = network(torch.from_numpy(ECHOES), torch.from_numpy(ACTIONS)).q
    torch.testing.assert_close(flat(torch.from_numpy(FLAT)), expected)


def test_parameters_of_the_flat_network_fly_in_apex_bats_policy() -> None:
    network = FlatDueling(CONFIG)
    arrays = named(network.features, network.advantage, network.value)
    assert {k: v.shape for k, v in arrays.items()} == parameter_shapes(CONFIG.network, CONFIG.state_steps)
    expected = network(torch.from_numpy(FLAT)).detach().numpy()
    np.testing.assert_allclose(values(arrays), expected, atol=1e-5)


def test_a_single_stream_chooses_the_same_in_apex_bats_policy_and_has_about_as_many_parameters() -> None:
    features, width = Features(CONFIG), single_width(CONFIG)
    stream = nn.Sequential(nn.Linear(features.width, width), nn.ReLU(), nn.Linear(width, 3))
    q = stream(features(torch.from_numpy(FLAT))).detach().numpy()
    arrays = named(features, stream)
    np.testing.assert_array_equal(values(arrays).argmax(axis=1), q.argmax(axis=1))
    network = DuelingNetwork(CONFIG.network, CONFIG.state_steps)
    single = sum(p.numel() for p in stream.parameters()) + sum(p.numel() for p in features.parameters())
    assert single == pytest.approx(sum(p.numel() for p in network.parameters()), rel=0.01)


def values(
    arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Returns what apex_bat's policy says with these parameters."""
    from benchmarks.peers.environments import unflatten

    policy = Policy(fitting(CONFIG.network, arrays), CONFIG.state_steps)
    policy.load(arrays)
    return policy(unflatten(FLAT)).q
