"""What travels from an actor to the learner: chunks of flight, n-step transitions, states and batches.

A *step* is one call of the bat: a frame is heard, an action is chosen. A chunk holds consecutive steps of one bat's
episode, each echo frame once, and the transitions that start in it; a state is stacked from the frames when it is
needed. A transition stores the discount of its bootstrap (gamma^n, or 0 after a termination) and never a done flag, so
that a time limit is a truncation and bootstraps (dqn_zoo stores transitions in the same way).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

NUM_EARS = 2
NUM_BINS = 24
NUM_ACTIONS = 3
ACTION_MEMORY = 3
NO_ACTION = 255  # stands in `Chunk.actions` for the step of the last frame, whose action is not known yet


class States(NamedTuple):
    """A batch of what the policy sees (thesis eq. 3.2.1)."""

    echoes: NDArray[np.float32]
    """(batch, 2 * memory_steps, 24): rows are (oldest left, oldest right, ..., newest left, newest right)."""
    actions: NDArray[np.uint8]
    """(batch, 3): the actions a_{t-3}, a_{t-2}, a_{t-1}; 0 (straight) before the first."""


class Chunk(NamedTuple):
    """Consecutive steps of one episode of one bat, and the transitions that start among them.

    Row k is step `first_step + k` of the episode. The first rows only give context: the frames and actions that the
    first transition's state needs from before it.
    """

    first_step: int
    """Step number of row 0 within its episode; rows before step 0 do not exist and count as silence."""
    frames: NDArray[np.float32]
    """(rows, 2, 24): the echo frame heard at each step, left then right, after the condition onset was applied."""
    actions: NDArray[np.uint8]
    """(rows,): the action chosen at each step; NO_ACTION at the last row if the episode goes on or ended there."""
    starts: NDArray[np.uint16]
    """(transitions,): row at which each transition starts."""
    spans: NDArray[np.uint8]
    """(transitions,): steps that each covers, n or fewer at the end of an episode; its next state is row start+span."""
    rewards: NDArray[np.float32]
    """(transitions,): sum of gamma^k r_{t+k} over the span."""
    discounts: NDArray[np.float32]
    """(transitions,): gamma^span, or 0 after a termination."""
    priorities: NDArray[np.float32]
    """(transitions,): |TD error| with the actor's weights, before epsilon and exponent."""


class Batch(NamedTuple):
    """What the replay hands to the learner."""

    items: NDArray[np.int64]
    """(batch,): item numbers, never reused; priorities go back under them."""
    weights: NDArray[np.float32]
    """(batch,): importance weights, 1 at the greatest of the batch."""
    states: States
    actions: NDArray[np.uint8]
    """(batch,): the action taken in `states`."""
    rewards: NDArray[np.float32]
    """(batch,): n-step rewards."""
    discounts: NDArray[np.float32]
    """(batch,): discount of the bootstrap from `next_states`."""
    next_states: States
    """Where the span of each transition ends."""


def stack_state(
    frames: NDArray[np.float32],
    actions: NDArray[np.uint8],
    rows: NDArray[np.int64],
    first_step: int,
    memory_steps: int,
    heard_steps: int,
) -> States:
    """Returns the states at some rows of a chunk (or of a whole episode).

    Args:
        frames: float32 (total, 2, 24), one row a step.
        actions: uint8 (total,), the action chosen at each step.
        rows: int64 (batch,), rows whose states are wanted.
        first_step: step number of row 0 within the episode.
        memory_steps: frames in a state.
        heard_steps: how many of them, counted from the newest, are not blanked (1 in the condition no_memory).

    Rows before the first step of the episode are silent (zeros), actions before it are 0.
    """
    back = np.arange(memory_steps - 1, -1, -1)
    source = rows[:, None] - back
    missing = (source + first_step < 0) | (back >= heard_steps)
    if (source[~missing] < 0).any():
        raise ValueError("a state needs frames from before the first row")
    echoes = frames[np.maximum(source, 0)]
    echoes[missing] = 0.0
    before = rows[:, None] - np.arange(ACTION_MEMORY, 0, -1)
    taken = actions[np.maximum(before, 0)]
    taken[before + first_step < 0] = 0
    return States(echoes.reshape(len(rows), memory_steps * NUM_EARS, NUM_BINS), taken)
