"""From single steps of a bat to chunks of n-step transitions with their first priorities (Ape-X, algorithm 1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import ACTION_MEMORY, NO_ACTION, NUM_BINS, NUM_EARS, Chunk
from apex_bat.storage import State


class Accumulator:
    """Gathers the steps of one bat and gives out chunks.

    Row k of the lists is step `_first_step + k` of the episode. Rows that a later state still needs are kept.
    """

    def __init__(self, num_step: int, discount: float, memory_steps: int, chunk_transitions: int) -> None:
        self._num_step = num_step
        self._gammas = discount ** np.arange(num_step + 1, dtype=np.float64)
        self._context = max(memory_steps - 1, ACTION_MEMORY)
        self._chunk_transitions = chunk_transitions
        self._first_step = 0
        self._next_start = 0  # row of the first step whose transition was not given out yet
        self._frames: list[NDArray[np.float32]] = []
        self._actions: list[int] = []
        self._rewards: list[float] = []
        self._q_taken: list[float] = []
        self._next_q_max: list[float] = []

    def step(self, frame: NDArray[np.float32], action: int, reward: float, q_taken: float, next_q_max: float) -> None:
        """Takes one step.

        Args:
            frame: float32 (2, 24), what was heard before the action.
            action: the action chosen.
            reward: what followed.
            q_taken: Q(s_t, a_t) by the actor's weights.
            next_q_max: max_a Q(s_{t+1}, a) by the same weights.
        """
        self._frames.append(frame)
        self._actions.append(action)
        self._rewards.append(reward)
        self._q_taken.append(q_taken)
        self._next_q_max.append(next_q_max)

    def full_chunk(self, newest_frame: NDArray[np.float32]) -> Chunk | None:
        """Returns a chunk if enough transitions are complete; the frame is the one heard after the last step."""
        if len(self._rewards) - self._next_start < self._chunk_transitions + self._num_step - 1:
            return None
        return self._cut(newest_frame, self._chunk_transitions, terminated=False)

    def end(self, final_frame: NDArray[np.float32], terminated: bool) -> Chunk | None:
        """Returns what is left of the episode, with shorter spans at its end, and forgets it; None if nothing is.

        Args:
            final_frame: float32 (2, 24), heard after the last step.
            terminated: the episode ended by itself (no bootstrap); False: a time limit cut it (bootstraps).
        """
        left = len(self._rewards) - self._next_start
        chunk = self._cut(final_frame, left, terminated) if left else None
        self._forget(len(self._rewards))
        self._first_step = self._next_start = 0
        return chunk

    def state(self) -> State:
        """Returns the steps that are gathered and not given out, with their context."""
        rows = len(self._rewards)
        values = {"first_step": self._first_step, "next_start": self._next_start}
        frames = np.stack(self._frames) if rows else np.zeros((0, NUM_EARS, NUM_BINS), np.float32)
        arrays: dict[str, NDArray[Any]] = {
            "frames": frames,
            "actions": np.array(self._actions, np.int64),
            "rewards": np.array(self._rewards, np.float64),
            "q_taken": np.array(self._q_taken, np.float64),
            "next_q_max": np.array(self._next_q_max, np.float64),
        }
        return State(values, arrays)

    def restore(self, state: State) -> None:
        """Continues from what `state` returned."""
        arrays = state.arrays
        self._first_step, self._next_start = state.values["first_step"], state.values["next_start"]
        self._frames = list(arrays["frames"])
        self._actions, self._rewards = arrays["actions"].tolist(), arrays["rewards"].tolist()
        self._q_taken, self._next_q_max = arrays["q_taken"].tolist(), arrays["next_q_max"].tolist()

    def _cut(self, newest_frame: NDArray[np.float32], count: int, terminated: bool) -> Chunk:
        start, steps = self._next_start, len(self._rewards)
        starts = np.arange(start, start + count)
        spans = np.minimum(self._num_step, steps - starts)
        rewards, discounts = n_step_returns(np.asarray(self._rewards), starts, spans, self._gammas)
        if terminated:
            discounts[starts + spans == steps] = 0.0
        bootstraps = np.asarray(self._next_q_max)[starts + spans - 1]
        errors = rewards + discounts * bootstraps - np.asarray(self._q_taken)[starts]

        rows = int(starts[-1] + spans[-1]) + 1
        frames = [*self._frames, newest_frame][:rows]
        actions = [*self._actions, NO_ACTION][:rows]
        chunk = Chunk(
            self._first_step, np.stack(frames).astype(np.float32), np.array(actions, np.uint8),
            starts.astype(np.uint16), spans.astype(np.uint8), rewards.astype(np.float32),
            discounts.astype(np.float32), np.abs(errors).astype(np.float32),
        )  # fmt: skip
        self._next_start = start + count
        self._forget(max(0, self._next_start - self._context))
        return chunk

    def _forget(self, count: int) -> None:
        for rows in (self._frames, self._actions, self._rewards, self._q_taken, self._next_q_max):
            del rows[:count]
        self._first_step += count
        self._next_start -= count


def n_step_returns(
    rewards: NDArray[np.float64], starts: NDArray[np.int64], spans: NDArray[np.int64], gammas: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns sum_{k < span} gamma^k r_{start + k} and gamma^span, each float64 (transitions,).

    Args:
        rewards: (steps,) rewards of consecutive steps.
        starts: (transitions,) step at which each begins.
        spans: (transitions,) steps that each covers, at least 1.
        gammas: (greatest span + 1,) powers of the discount from gamma^0.
    """
    back = np.arange(spans.max(initial=1))
    inside = back < spans[:, None]
    steps = np.where(inside, starts[:, None] + back, 0)
    return (rewards[steps] * gammas[back] * inside).sum(axis=1), gammas[spans]
