"""The learning agent on problems whose answer is known."""

import msgspec
import numpy as np
import pytest
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.agent.mirror import mirror_batch
from apex_bat.config import Config
from apex_bat.config.settings import Learner, Network
from apex_bat.experience import Batch, States

CPU = torch.device("cpu")
SMALL = Network(channels=(4,), strides=(2,), hidden=(32,), input_scale=1.0)


def agent(**learner: object) -> D3QN:
    """Learns without mirror images, which the problems below do not have."""
    torch.manual_seed(0)
    settings = Learner(**({"mirror": False} | learner))  # type: ignore[arg-type]
    return D3QN(msgspec.structs.replace(Config(), network=SMALL, learner=settings), CPU)


def states(kinds: np.ndarray) -> States:
    """State 0 hears the left ear, state 1 the right."""
    echoes = np.zeros((len(kinds), 6, 24), np.float32)
    echoes[np.arange(len(kinds)), 4 + kinds] = 1.0
    return States(echoes, np.zeros((len(kinds), 3), np.uint8))


def two_state_batch(generator: np.random.Generator, size: int = 64, gamma: float = 0.8) -> Batch:
    """Draws from a problem with a known answer: Q(1, .) = 2, Q(0, 1) = 1 + 2 gamma, Q(0, else) = gamma Q(0, 1).

    Action 1 in state 0 pays 1 and leads to state 1, which any action ends with reward 2; others pay 0 and stay.
    """
    kinds = generator.integers(0, 2, size)
    actions = generator.integers(0, 3, size).astype(np.uint8)
    forward = (kinds == 0) & (actions == 1)
    rewards = np.where(kinds == 1, 2.0, np.where(forward, 1.0, 0.0)).astype(np.float32)
    discounts = np.where(kinds == 1, 0.0, gamma).astype(np.float32)
    following = np.where(forward, 1, 0)
    return Batch(
        np.arange(size), np.ones(size, np.float32), states(kinds), actions, rewards, discounts, states(following)
    )


def test_a_two_state_problem_is_solved() -> None:
    learner = agent(learning_rate=0.001, target_period=20)
    generator = np.random.default_rng(0)
    for _ in range(800):
        learner.update(two_state_batch(generator))
    learner.online.eval()
    both = states(np.array([0, 1]))
    with torch.no_grad():
        q = learner.online(torch.from_numpy(both.echoes), torch.from_numpy(both.actions)).q.numpy()
    best = 1.0 + 0.8 * 2.0
    np.testing.assert_allclose(q, [[0.8 * best, best, 0.8 * best], [2.0, 2.0, 2.0]], atol=0.1)


def test_target_network_is_copied_every_period_and_not_between() -> None:
    learner = agent(target_period=3)
    generator = np.random.default_rng(0)
    same = []
    for _ in range(6):
        learner.update(two_state_batch(generator))
        pairs = zip(learner.online.parameters(), learner.target.parameters(), strict=True)
        same.append(all(torch.equal(a, b) for a, b in pairs))
    assert same == [False, False, True, False, False, True]


def test_soft_target_moves_by_tau() -> None:
    learner = agent(target_period=0, target_tau=0.25)
    before = [p.clone() for p in learner.target.parameters()]
    learner.update(two_state_batch(np.random.default_rng(0)))
    for old, new, online in zip(before, learner.target.parameters(), learner.online.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.25 * (online - old))


def test_the_average_is_that_of_the_newest_updates_and_exponential_after_them() -> None:
    learner = agent(averaged_updates=2)
    generator = np.random.default_rng(0)
    averaged = learner.weights()["value.0.weight"]
    for update in range(1, 41):
        learner.update(two_state_batch(generator))
        share = 1.0 / min(2.0, max(0.1 * update, 1.0))  # all of it for 10 updates, a half from 20 on
        averaged = averaged + share * (learner.weights()["value.0.weight"] - averaged)
    found = learner.arrays()["average/value.0.weight"]
    np.testing.assert_allclose(found, averaged, rtol=1e-5, atol=1e-7)
    assert not np.allclose(found, learner.weights()["value.0.weight"], rtol=1e-5, atol=1e-7)


def test_averaging_changes_nothing_of_what_is_learnt() -> None:
    with_average, without = agent(averaged_updates=100), agent(averaged_updates=0)
    generator = np.random.default_rng(0)
    for _ in range(5):
        batch = two_state_batch(generator)
        assert with_average.update(batch).loss == without.update(batch).loss
    assert not [name for name in without.arrays() if name.startswith("average/")]


def test_an_average_that_a_checkpoint_lacks_begins_from_its_online_network() -> None:
    without, with_average = agent(averaged_updates=0), agent(averaged_updates=100)
    without.update(two_state_batch(np.random.default_rng(0)))
    with_average.restore(without.arrays(), without.num_updates)
    for name, array in without.weights().items():
        np.testing.assert_array_equal(with_average.arrays()[f"average/{name}"], array)


def test_zero_weights_leave_the_network_as_it_was() -> None:
    learner = agent()
    before = learner.weights()
    batch = two_state_batch(np.random.default_rng(0))
    learner.update(batch._replace(weights=np.zeros_like(batch.weights)))
    for name, array in learner.weights().items():
        np.testing.assert_array_equal(array, before[name])


def test_errors_are_those_before_the_update() -> None:
    learner = agent()
    batch = two_state_batch(np.random.default_rng(0))
    batch = batch._replace(discounts=np.zeros_like(batch.discounts))
    with torch.no_grad():
        q = learner.online(torch.from_numpy(batch.states.echoes), torch.from_numpy(batch.states.actions)).q.numpy()
    expected = batch.rewards - np.take_along_axis(q, batch.actions[:, None].astype(int), 1)[:, 0]
    np.testing.assert_allclose(learner.update(batch).errors, expected, atol=1e-6)


def test_gradient_is_clipped_to_its_norm() -> None:
    loose, tight = agent(gradient_clip=0.0, optimiser="adam"), agent(gradient_clip=1e-12, optimiser="adam", epsilon=1.0)
    batch = two_state_batch(np.random.default_rng(0))
    before = tight.weights()
    assert loose.update(batch).gradient_norm == pytest.approx(tight.update(batch).gradient_norm, rel=1e-5)
    for name, array in tight.weights().items():
        np.testing.assert_allclose(array, before[name], atol=1e-7)


@pytest.mark.parametrize("optimiser", ["rmsprop", "adam"])
@pytest.mark.parametrize("centred", [True, False])
def test_a_restored_agent_goes_on_bit_for_bit(optimiser: str, centred: bool) -> None:
    original = agent(optimiser=optimiser, rmsprop_centred=centred, target_period=7, averaged_updates=4)
    generator = np.random.default_rng(0)
    batches = [two_state_batch(generator) for _ in range(10)]
    for batch in batches[:5]:
        original.update(batch)
    copy = agent(optimiser=optimiser, rmsprop_centred=centred, target_period=7, averaged_updates=4)
    copy.restore(original.arrays(), original.num_updates)
    for batch in batches[5:]:
        assert original.update(batch).loss == copy.update(batch).loss
    for name, array in original.arrays().items():
        np.testing.assert_array_equal(array, copy.arrays()[name])


@pytest.mark.slow
def test_a_compiled_network_learns_the_same() -> None:
    plain, compiled = agent(), agent(compile=True)
    batch = two_state_batch(np.random.default_rng(0))
    for _ in range(3):
        assert compiled.update(batch).loss == pytest.approx(plain.update(batch).loss, rel=1e-4)


def test_state_of_another_optimiser_is_refused() -> None:
    other = agent(optimiser="adam")
    arrays = {name: array for name, array in other.arrays().items() if not name.startswith("optimiser/")}
    with pytest.raises(ValueError, match="optimiser"):
        agent().restore(arrays, num_updates=3)


@pytest.mark.parametrize(
    "change",
    [
        {"learning_rate": 0.01},
        {"rmsprop_decay": 0.5},
        {"rmsprop_centred": True},
        {"epsilon": 0.1},
        {"weight_decay": 0.1},
        {"loss": "huber"},
        {"gradient_clip": 0.01},
        {"optimiser": "adam"},
        {"target_period": 1},
        {"target_period": 0},
        {"precision": "bfloat16"},
    ],
)
def test_every_setting_of_the_learner_changes_what_is_learned(change: dict[str, object]) -> None:
    def learn(learner: D3QN) -> np.ndarray:
        generator = np.random.default_rng(0)
        for _ in range(4):
            batch = two_state_batch(generator)
            learner.update(batch._replace(rewards=5.0 * batch.rewards))
        return learner.weights()["value.0.weight"]

    assert not np.array_equal(learn(agent()), learn(agent(**change)))


def test_targets_are_without_dropout() -> None:
    torch.manual_seed(0)
    network = msgspec.structs.replace(SMALL, dropout=0.5)
    settings = Learner(learning_rate=1e-12, mirror=False)
    learner = D3QN(msgspec.structs.replace(Config(), network=network, learner=settings), CPU)
    kinds = np.zeros(32, np.int64)
    batch = two_state_batch(np.random.default_rng(0), 32)._replace(next_states=states(kinds))
    seen: list[torch.Tensor] = []
    learner.online.register_forward_hook(lambda *call: seen.append(call[2].q.detach().clone()))
    learner.target.register_forward_hook(lambda *call: seen.append(call[2].q.detach().clone()))
    learner.update(batch)
    following_online, following_target, now = seen
    assert following_online.std(dim=0).max() == 0.0, "32 times the same state"
    assert following_target.std(dim=0).max() == 0.0
    assert now[batch.states.echoes[:, 4, 0] == 1.0].std(dim=0).max() > 0.0, "what is learned has dropout"


def test_with_mirror_every_other_transition_is_learnt_from_the_other_side_and_then_the_others() -> None:
    batch = two_state_batch(np.random.default_rng(0), size=6)
    odd = np.arange(6) % 2 == 1
    plain, mirrored = agent(), agent(mirror=True)
    for rows in (odd, ~odd):
        expected, got = plain.update(mirror_batch(batch, rows)), mirrored.update(batch)
        np.testing.assert_array_equal(got.errors, expected.errors)
    for name, array in mirrored.weights().items():
        np.testing.assert_array_equal(array, plain.weights()[name])
