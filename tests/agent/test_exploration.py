"""The epsilon ladder of Ape-X."""

import numpy as np
import pytest

from apex_bat.agent.exploration import annealed, choose_actions, ladder, ladder_of_actor
from apex_bat.config.settings import Exploration


def test_ladder_follows_the_paper() -> None:
    epsilons = ladder(8, Exploration())
    np.testing.assert_allclose(epsilons, [0.4 ** (1 + 7 * i / 7) for i in range(8)])


def test_a_single_bat_has_the_epsilon_of_its_setting() -> None:
    np.testing.assert_array_equal(ladder(1, Exploration(single=0.07)), [0.07])


def test_actors_share_the_ladder_without_gap_or_overlap() -> None:
    parts = [ladder_of_actor(a, 3, 4, Exploration()) for a in range(3)]
    np.testing.assert_allclose(np.sort(np.concatenate(parts))[::-1], ladder(12, Exploration()))
    assert all(part.max() > 0.1 and part.min() < 0.01 for part in parts)


@pytest.mark.parametrize(("steps", "epsilon"), [(0, 1.0), (50, 0.505), (100, 0.01), (10_000, 0.01)])
def test_annealing_is_linear_and_stops(steps: int, epsilon: float) -> None:
    assert annealed(steps, Exploration(anneal_steps=100)) == pytest.approx(epsilon)


def test_shares_of_random_actions_follow_each_bats_epsilon() -> None:
    generator = np.random.default_rng(0)
    q = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (3, 1))
    epsilons = np.array([0.0, 0.3, 1.0])
    draws = np.stack([choose_actions(q, epsilons, generator) for _ in range(6000)])
    greedy = (draws == 1).mean(axis=0)
    np.testing.assert_allclose(greedy, 1.0 - epsilons * 2.0 / 3.0, atol=0.03)
    assert greedy[0] == 1.0
