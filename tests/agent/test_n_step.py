"""Chunks of n-step transitions against a naive construction from the whole episode."""

from typing import Any

import numpy as np
import pytest

from apex_bat.agent.n_step import Accumulator
from apex_bat.experience import NO_ACTION, Chunk, stack_state

GAMMA = 0.9


def fly(
    steps: int, num_step: int, chunk: int, terminated: bool, memory_steps: int = 3
) -> tuple[list[Chunk], dict[str, Any]]:
    """Flies an episode of random numbers; frame k holds the number k + 1 everywhere."""
    generator = np.random.default_rng(steps * 100 + num_step)
    episode: dict[str, Any] = {
        "frames": np.broadcast_to(np.arange(1, steps + 2, dtype=np.float32)[:, None, None], (steps + 1, 2, 24)),
        "actions": generator.integers(0, 3, steps),
        "rewards": generator.normal(size=steps),
        "q": generator.normal(size=steps),
        "next_q": generator.normal(size=steps),
    }
    accumulator = Accumulator(num_step, GAMMA, memory_steps, chunk)
    chunks = []
    for t in range(steps):
        accumulator.step(
            episode["frames"][t],
            int(episode["actions"][t]),
            episode["rewards"][t],
            episode["q"][t],
            episode["next_q"][t],
        )
        cut = accumulator.full_chunk(episode["frames"][t + 1]) if t < steps - 1 else None
        chunks += [cut] if cut is not None else []
    last = accumulator.end(episode["frames"][steps], terminated)
    return [*chunks, *([last] if last is not None else [])], episode


@pytest.mark.parametrize("terminated", [True, False])
@pytest.mark.parametrize("num_step", [1, 3, 5])
@pytest.mark.parametrize("chunk", [1, 4, 50])
@pytest.mark.parametrize("steps", [1, 2, 3, 7, 23])
def test_every_step_starts_exactly_one_transition_with_the_right_return(
    steps: int, num_step: int, chunk: int, terminated: bool
) -> None:
    chunks, episode = fly(steps, num_step, chunk, terminated)
    seen = []
    for c in chunks:
        for k, row in enumerate(c.starts):
            t = c.first_step + int(row)
            span = min(num_step, steps - t)
            expected = sum(GAMMA**j * episode["rewards"][t + j] for j in range(span))
            discount = 0.0 if terminated and t + span == steps else GAMMA**span
            error = expected + discount * episode["next_q"][t + span - 1] - episode["q"][t]
            assert c.spans[k] == span
            assert c.rewards[k] == pytest.approx(expected, abs=1e-6)
            assert c.discounts[k] == pytest.approx(discount, abs=1e-6)
            assert c.priorities[k] == pytest.approx(abs(error), abs=1e-6)
            seen.append(t)
    assert seen == list(range(steps))


@pytest.mark.parametrize("memory_steps", [1, 3, 5])
def test_states_from_chunks_are_those_of_the_whole_episode(memory_steps: int) -> None:
    chunks, episode = fly(30, 3, 7, terminated=True, memory_steps=memory_steps)
    actions = np.append(episode["actions"], NO_ACTION).astype(np.uint8)
    whole = stack_state(episode["frames"], actions, np.arange(31), 0, memory_steps, memory_steps)
    for c in chunks:
        for rows in (c.starts.astype(np.int64), c.starts.astype(np.int64) + c.spans):
            states = stack_state(c.frames, c.actions, rows, c.first_step, memory_steps, memory_steps)
            np.testing.assert_array_equal(states.echoes, whole.echoes[c.first_step + rows])
            np.testing.assert_array_equal(states.actions, whole.actions[c.first_step + rows])


def test_frames_before_the_episode_are_silent_and_actions_before_it_straight() -> None:
    frames = np.ones((4, 2, 24), np.float32)
    states = stack_state(frames, np.array([1, 2, 1, NO_ACTION], np.uint8), np.array([0, 1, 3]), 0, 3, 3)
    np.testing.assert_array_equal(states.echoes[:, ::2, 0], [[0, 0, 1], [0, 1, 1], [1, 1, 1]])
    np.testing.assert_array_equal(states.actions, [[0, 0, 0], [0, 0, 1], [1, 2, 1]])


def test_no_memory_blanks_all_but_the_newest_echo() -> None:
    frames = np.ones((5, 2, 24), np.float32)
    states = stack_state(frames, np.zeros(5, np.uint8), np.array([4]), 0, 3, 1)
    np.testing.assert_array_equal(states.echoes[0, :, 0], [0, 0, 0, 0, 1, 1])


def test_a_state_that_reaches_before_its_chunk_is_refused() -> None:
    frames = np.ones((5, 2, 24), np.float32)
    with pytest.raises(ValueError, match="before the first row"):
        stack_state(frames, np.zeros(5, np.uint8), np.array([1]), 7, 3, 3)


def test_chunks_of_a_long_flight_carry_few_frames_twice() -> None:
    chunks, _ = fly(1000, 3, 50, terminated=False)
    assert sum(len(c.frames) for c in chunks) <= 1.15 * 1000
