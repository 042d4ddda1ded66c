"""Sharing a batch out over servers: exact in the mean, paid for by who has earned it, and weighted rightly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from apex_bat.experience import Chunk
from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.shares import DrawnPart, charges, drawn_sizes, joined, misplaced_share
from apex_bat.transport.messages import Standing

MakeChunk = Callable[..., Chunk]


def test_sizes_are_the_shares_of_the_totals_in_the_mean_and_within_one_draw(generator: np.random.Generator) -> None:
    totals = [3.0, 0.0, 1.0, 0.21]
    wanted = 32 * np.array(totals) / sum(totals)
    drawn = np.array([drawn_sizes(totals, 32, generator) for _ in range(4000)])
    assert (drawn.sum(axis=1) == 32).all()
    assert (np.abs(drawn - wanted) < 2).all(), "stratified: no server is far from its share in any batch"
    np.testing.assert_allclose(drawn.mean(axis=0), wanted, atol=0.05)
    assert not drawn[:, 1].any()


@pytest.mark.filterwarnings("error")
def test_of_no_draws_none_falls_to_anybody(generator: np.random.Generator) -> None:
    np.testing.assert_array_equal(drawn_sizes([3.0, 1.0], 0, generator), [0, 0])


def test_charges_add_up_level_the_servers_and_overdraw_none(generator: np.random.Generator) -> None:
    for _ in range(500):
        earned = generator.integers(0, 200, generator.integers(1, 9))
        amount = int(generator.integers(0, earned.sum() + 1))
        taken = charges(earned.tolist(), amount)
        left = earned - taken
        assert taken.sum() == amount
        assert (taken >= 0).all()
        assert (left >= 0).all()
        if taken.any():
            assert left[taken > 0].max() - left[taken > 0].min() <= 1, "who pays is left with as much as the others"
            assert left.max() <= left[taken > 0].min() + 1, "nobody who has more left pays nothing"


def test_more_than_all_have_earned_is_owed_evenly() -> None:
    taken = charges([10, 0, 3], 100)
    assert taken.sum() == 100
    assert np.ptp(np.array([10, 0, 3]) - taken) <= 1


def test_weights_are_those_of_the_probability_by_which_each_item_was_drawn(
    make_chunk: MakeChunk, generator: np.random.Generator
) -> None:
    beta, chances = 0.7, (0.8, 0.2)
    parts, probabilities = [], []
    for server, transitions in enumerate((30, 50)):
        buffer = ReplayBuffer(100, 200, 3, 3, alpha=1.0)
        chunk = make_chunk(transitions)
        buffer.add([chunk], chunk.priorities + np.float32(0.01))
        sampled = buffer.sample(20, beta, generator)
        standing = Standing(1, len(buffer), buffer.total, 0, beta, sampled.largest_weight)
        parts.append(DrawnPart(server, sampled.batch, standing, chances[server]))
        shares = (chunk.priorities + np.float32(0.01)) / buffer.total
        probabilities.append(chances[server] * shares[sampled.batch.items])
    batch = joined(parts, 2)
    wanted = np.concatenate(probabilities) ** -beta
    np.testing.assert_allclose(batch.weights, wanted / wanted.max(), rtol=1e-4)
    assert set(batch.items[:20] % 2) == {0}
    assert set(batch.items[20:] % 2) == {1}
    assert batch.states.echoes.shape == batch.next_states.echoes.shape == (40, 6, 24)


def test_a_part_keeps_all_that_belongs_to_its_items(make_chunk: MakeChunk, generator: np.random.Generator) -> None:
    buffer, chunk = ReplayBuffer(100, 200, 3, 3, alpha=1.0), make_chunk(30)
    buffer.add([chunk], chunk.priorities + np.float32(0.01))
    sampled = buffer.sample(8, 0.4, generator)
    standing = Standing(1, 30, buffer.total, 0, 0.4, sampled.largest_weight)
    batch = joined([DrawnPart(2, sampled.batch, standing, 1.0)], 3)
    items = (batch.items - 2) // 3
    np.testing.assert_array_equal(batch.rewards, chunk.rewards[items])
    np.testing.assert_array_equal(batch.actions, chunk.actions[chunk.starts[items]])
    np.testing.assert_allclose(batch.weights, sampled.batch.weights, rtol=1e-6)


@pytest.mark.parametrize(("chances", "totals", "share"), [((0.5, 0.5), (1, 3), 0.25), ((0.2, 0.8), (2, 8), 0.0)])
def test_the_misplaced_share_is_what_newer_totals_would_have_sent_elsewhere(
    chances: tuple[float, float], totals: tuple[float, float], share: float
) -> None:
    assert misplaced_share(np.array(chances), totals) == pytest.approx(share)
