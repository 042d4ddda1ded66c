"""The dueling network, and its twin in numpy."""

import math

import numpy as np
import pytest
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.agent.inference import Policy, initial_parameters, parameter_shapes, part_norms
from apex_bat.agent.network import DuelingNetwork, load_parameters, parameters_of
from apex_bat.config import load
from apex_bat.config.settings import Network
from apex_bat.experience import States
from apex_bat.roles.metrics import LEARNER_METRICS


def random_states(batch: int, memory_steps: int = 3) -> States:
    generator = np.random.default_rng(3)
    echoes = generator.random((batch, 2 * memory_steps, 24), np.float32)
    return States(echoes, generator.integers(0, 3, (batch, 3)).astype(np.uint8))


def values_of(network: DuelingNetwork, states: States) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    with torch.no_grad():
        values = network(torch.from_numpy(states.echoes), torch.from_numpy(states.actions))
    return values.q.numpy(), values.value.numpy(), values.advantage.numpy()


NETWORKS = [
    Network(),
    Network(dueling="max"),
    Network(channels=(4,), strides=(1,), hidden=()),
    Network(channels=(4, 5, 6), strides=(2, 1, 3), hidden=(16, 8), dropout=0.3, input_scale=2.0),
]


@pytest.mark.parametrize("settings", NETWORKS)
@pytest.mark.parametrize("memory_steps", [1, 3, 5])
def test_numpy_policy_computes_the_same_values_as_torch(settings: Network, memory_steps: int) -> None:
    torch.manual_seed(1)
    network = DuelingNetwork(settings, memory_steps).eval()
    policy = Policy(settings, memory_steps)
    policy.load(parameters_of(network))
    states = random_states(5, memory_steps)
    for ours, theirs in zip(policy(states), values_of(network, states), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-6)


@pytest.mark.parametrize("settings", NETWORKS)
def test_declared_shapes_are_those_of_the_network(settings: Network) -> None:
    network = DuelingNetwork(settings, 3)
    assert parameter_shapes(settings, 3) == {name: tuple(p.shape) for name, p in network.state_dict().items()}


def test_mean_form_centres_advantages_and_max_form_makes_value_the_best_action() -> None:
    states = random_states(4)
    q, value, _ = values_of(DuelingNetwork(Network(dueling="mean"), 3), states)
    np.testing.assert_allclose(q.mean(axis=1, keepdims=True), value, atol=1e-6)
    q, value, _ = values_of(DuelingNetwork(Network(dueling="max"), 3), states)
    np.testing.assert_allclose(q.max(axis=1, keepdims=True), value, atol=1e-6)


def test_filters_treat_each_echo_row_by_itself() -> None:
    network = DuelingNetwork(Network(), 3)
    states = random_states(1)
    features = []
    hook = network.filters[-1].register_forward_hook(lambda _m, _i, output: features.append(output.detach().numpy()))
    values_of(network, states)
    states.echoes[0, 2] += 1.0  # one row changes
    values_of(network, states)
    hook.remove()
    changed = np.abs(features[1] - features[0]).max(axis=(0, 1, 3)) > 0.0
    np.testing.assert_array_equal(changed, [False, False, True, False, False, False])


def test_action_memory_matters() -> None:
    network = DuelingNetwork(Network(), 3)
    states = random_states(1)
    before = values_of(network, states)[0]
    states.actions[0, 1] = (states.actions[0, 1] + 1) % 3
    assert np.abs(values_of(network, states)[0] - before).max() > 0.0


def test_dropout_acts_in_training_only() -> None:
    network = DuelingNetwork(Network(dropout=0.5), 3)
    states = random_states(1)
    assert not np.array_equal(values_of(network, states)[0], values_of(network, states)[0])
    network.eval()
    np.testing.assert_array_equal(values_of(network, states)[0], values_of(network, states)[0])


def test_strides_that_leave_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="leave nothing"):
        parameter_shapes(Network(channels=(4, 4, 4), strides=(3, 3, 3)), 3)


def test_weights_of_another_network_are_refused_by_name() -> None:
    arrays = parameters_of(DuelingNetwork(Network(hidden=(64,)), 3))
    with pytest.raises(ValueError, match=r"advantage\.0\.bias is \(64,\), needed \(128,\)"):
        Policy(Network(), 3).load(arrays)
    with pytest.raises(ValueError, match="another network"):
        load_parameters(DuelingNetwork(Network(), 3), arrays)


@pytest.mark.parametrize("settings", NETWORKS)
def test_initial_parameters_are_drawn_as_torch_draws_them(settings: Network) -> None:
    ours = initial_parameters(settings, 3, seed=5)
    torch.manual_seed(0)
    for name, theirs in parameters_of(DuelingNetwork(settings, 3)).items():
        assert (ours[name].shape, ours[name].dtype) == (theirs.shape, theirs.dtype)
        if theirs.size > 1000:  # the greatest of so many is the bound, to a percent
            assert np.abs(ours[name]).max() == pytest.approx(np.abs(theirs).max(), rel=0.01)
            assert ours[name].std() == pytest.approx(theirs.std(), rel=0.1)
            assert abs(ours[name].mean()) < 0.1 * theirs.std()


def test_initial_parameters_follow_from_the_seed() -> None:
    one, again, other = (initial_parameters(Network(), 3, seed)["value.0.weight"] for seed in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def test_a_learner_begins_with_the_initial_parameters() -> None:
    config = load(None, ["seed=7"])
    for name, array in initial_parameters(config.network, config.state_steps, 7).items():
        np.testing.assert_array_equal(D3QN(config, torch.device("cpu")).weights()[name], array)


def test_norms_are_those_of_whole_parts() -> None:
    parameters = {"value.0.weight": np.full((3, 3), 2.0, np.float32), "value.0.bias": np.array([8.0], np.float32)}
    assert part_norms({**parameters, "filters.0.bias": np.zeros(2, np.float32)}) == {
        "weights_norm.value": 10.0,
        "weights_norm.filters": 0.0,
    }


def test_every_part_of_the_network_is_declared() -> None:
    norms = part_norms(D3QN(load(None), torch.device("cpu")).weights())
    assert norms.keys() <= LEARNER_METRICS.keys()
    assert all(math.isfinite(norm) and norm > 0.0 for norm in norms.values())
