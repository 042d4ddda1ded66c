"""The buffer against the chunks that went in and a list that does the same slowly."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from apex_bat.experience import Chunk, States, stack_state
from apex_bat.replay.buffer import BufferCounters, ReplayBuffer

MakeChunk = Callable[..., Chunk]


def buffer_of(capacity: int = 100, num_rows: int = 400, heard_steps: int = 3, alpha: float = 0.6) -> ReplayBuffer:
    return ReplayBuffer(capacity, num_rows, memory_steps=3, heard_steps=heard_steps, alpha=alpha)


def add(buffer: ReplayBuffer, chunk: Chunk, actor: int = 0, learner_step: int = 0) -> None:
    buffer.check([chunk])
    buffer.add([chunk], chunk.priorities + np.float32(0.001), actor, learner_step)


class Held(NamedTuple):
    """A transition of the naive twin."""

    states: States
    next_states: States
    action: int
    reward: float
    priority: float


def transitions_of(chunk: Chunk, heard_steps: int = 3) -> list[Held]:
    starts, spans = chunk.starts.astype(np.int64), chunk.spans.astype(np.int64)

    def at(row: int) -> States:
        return stack_state(chunk.frames, chunk.actions, np.array([row]), chunk.first_step, 3, heard_steps)

    return [
        Held(at(start), at(start + span), int(chunk.actions[start]), float(reward), float(priority) + 0.001)
        for start, span, reward, priority in zip(starts, spans, chunk.rewards, chunk.priorities, strict=True)
    ]


@pytest.mark.parametrize("heard_steps", [1, 3])
def test_batches_hold_what_the_chunks_held_across_wraps_and_episode_starts(
    make_chunk: MakeChunk, generator: np.random.Generator, heard_steps: int
) -> None:
    buffer = buffer_of(capacity=60, num_rows=97, heard_steps=heard_steps)
    twin: list[Held] = []
    for index in range(40):
        first_step = [0, 1, 20, 300][index % 4]
        chunk = make_chunk(int(generator.integers(1, 15)), first_step, span=int(generator.integers(1, 4)))
        add(buffer, chunk)
        twin += transitions_of(chunk, heard_steps)
        batch = buffer.sample(20, 0.4, generator).batch
        for i, item in enumerate(batch.items):
            held = twin[item]
            np.testing.assert_array_equal(batch.states.echoes[i], held.states.echoes[0])
            np.testing.assert_array_equal(batch.states.actions[i], held.states.actions[0])
            np.testing.assert_array_equal(batch.next_states.echoes[i], held.next_states.echoes[0])
            np.testing.assert_array_equal(batch.next_states.actions[i], held.next_states.actions[0])
            assert batch.actions[i] == held.action
            assert batch.rewards[i] == np.float32(held.reward)


def test_chunks_added_together_equal_chunks_added_one_by_one(
    make_chunk: MakeChunk, generator: np.random.Generator
) -> None:
    one, other = buffer_of(capacity=90, num_rows=150), buffer_of(capacity=90, num_rows=150)
    for _ in range(12):
        chunks = [make_chunk(int(generator.integers(1, 12)), first_step) for first_step in (0, 5, 300)]
        one.check(chunks)
        one.add(chunks, np.concatenate([chunk.priorities for chunk in chunks]) + np.float32(0.001))
        for chunk in chunks:
            add(other, chunk)
        assert one.counters == other.counters
        seed = int(generator.integers(1000))
        drawn = [buffer.sample(40, 0.4, np.random.default_rng(seed)).batch for buffer in (one, other)]
        np.testing.assert_equal(drawn[0], drawn[1])


def test_probabilities_follow_a_naive_list_under_random_operations(
    make_chunk: MakeChunk, generator: np.random.Generator
) -> None:
    buffer = buffer_of(capacity=70, num_rows=200)
    priorities: dict[int, float] = {}
    added = 0
    for _ in range(200):
        if generator.random() < 0.5:
            chunk = make_chunk(int(generator.integers(1, 20)))
            add(buffer, chunk)
            for priority in chunk.priorities:
                priorities[added] = float(priority + np.float32(0.001))
                added += 1
            priorities = {item: p for item, p in priorities.items() if item >= buffer.counters.first_item}
        elif added:
            items = np.unique(generator.integers(max(0, added - 120), added + 5, 10))
            values = generator.random(len(items), dtype=np.float32) + np.float32(0.01)
            late = buffer.update(items, values)
            known = [item for item in items.tolist() if item in priorities]
            assert late == len(items) - len(known)
            priorities |= {i: float(v) for i, v in zip(items.tolist(), values, strict=True) if i in known}
        assert len(buffer) == len(priorities) <= 70
        assert buffer._tree.total == pytest.approx(sum(p**0.6 for p in priorities.values()), rel=1e-6)


def test_the_oldest_go_first_and_before_new_ones_are_added(make_chunk: MakeChunk) -> None:
    buffer = buffer_of(capacity=25)
    for added in range(10, 200, 10):
        add(buffer, make_chunk(10))
        assert buffer.counters.next_item == added
        assert buffer.counters.first_item == max(0, added - 25)


def test_old_transitions_go_when_rows_run_out(make_chunk: MakeChunk, generator: np.random.Generator) -> None:
    buffer = buffer_of(capacity=100, num_rows=50)
    for _ in range(20):
        add(buffer, make_chunk(1))  # 7 rows a transition
    assert 6 <= len(buffer) <= 7
    assert set(buffer.sample(50, 0.4, generator).batch.items) <= set(range(13, 20))


def test_a_late_priority_changes_nothing(make_chunk: MakeChunk) -> None:
    buffer = buffer_of(capacity=20)
    for _ in range(3):
        add(buffer, make_chunk(10))
    total = buffer._tree.total
    assert buffer.update(np.array([0, 9, 30]), np.full(3, 9.0, np.float32)) == 3
    assert buffer._tree.total == total


def test_importance_weights_are_those_of_the_paper(make_chunk: MakeChunk, generator: np.random.Generator) -> None:
    buffer = buffer_of()
    chunk = make_chunk(50)
    add(buffer, chunk)
    sampled = buffer.sample(32, 0.5, generator).batch
    priorities = (chunk.priorities.astype(np.float64) + 0.001) ** 0.6
    expected = (50 * priorities[sampled.items] / priorities.sum()) ** -0.5
    np.testing.assert_allclose(sampled.weights, expected / expected.max(), rtol=1e-5)
    assert sampled.weights.max() == 1.0


def test_another_alpha_is_another_distribution(make_chunk: MakeChunk) -> None:
    buffer = buffer_of()
    chunk = make_chunk(50)
    add(buffer, chunk)
    buffer.set_alpha(0.0)
    assert buffer._tree.total == pytest.approx(50.0)
    buffer.set_alpha(1.0)
    assert buffer._tree.total == pytest.approx((chunk.priorities.astype(np.float64) + 0.001).sum())


def test_sampled_items_carry_their_origin(make_chunk: MakeChunk, generator: np.random.Generator) -> None:
    buffer = buffer_of()
    add(buffer, make_chunk(10), actor=3, learner_step=70)
    add(buffer, make_chunk(10), actor=4, learner_step=90)
    sampled = buffer.sample(64, 0.4, generator)
    from_first = sampled.batch.items < 10
    np.testing.assert_array_equal(sampled.actors, np.where(from_first, 3, 4))
    np.testing.assert_array_equal(sampled.learner_steps, np.where(from_first, 70, 90))


def test_a_million_transitions_fit_in_600_mb() -> None:
    # Rows as the store reserves them for chunks of 50; the arrays are never touched here, so this costs nothing.
    buffer = buffer_of(capacity=1_000_000, num_rows=1_232_000)
    assert buffer.nbytes / 1e6 < 600
    assert buffer.nbytes / 1e6 == pytest.approx(280, abs=1)  # what the module's docstring says


def test_a_chunk_without_context_is_refused(make_chunk: MakeChunk) -> None:
    chunk = make_chunk(10, first_step=20)._replace(starts=np.arange(2, 12, dtype=np.uint16))
    with pytest.raises(ValueError, match="the state there needs 3"):
        buffer_of().check([chunk])


def test_a_chunk_larger_than_the_buffer_is_refused(make_chunk: MakeChunk) -> None:
    with pytest.raises(ValueError, match="too many"):
        buffer_of(capacity=9).check([make_chunk(10)])


def test_counters_that_contradict_the_rings_are_refused(make_chunk: MakeChunk) -> None:
    buffer = buffer_of(capacity=20)
    add(buffer, make_chunk(10))
    for counters in [BufferCounters(0, 30, 16), BufferCounters(0, 10, 5), BufferCounters(0, 11, 16)]:
        with pytest.raises(ValueError, match=r"items|row|priority"):
            buffer.restore(counters)
        assert len(buffer) == 0
