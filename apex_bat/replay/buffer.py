"""The replay's memory: each echo frame of a chunk once, transitions that point at them, priorities in a sum tree.

Two rings. *Rows* hold frame, action and step number of every step of a chunk, and are named by numbers that only grow;
*items* are the transitions, named by permanent item numbers, so that a priority which comes late cannot land on another
item (`ReplayStore.first_number` sees to it after a restart). A row takes 194 bytes, an item 32 and 8.5 in the tree.
Chunks of 50 transitions have 56 rows, and the ring a tenth in reserve, which makes 280 bytes a transition: 280 MB a
million. With both states in each it would be 1,190.

Rows are written once: a snapshot can copy them while the buffer is in use (see `snapshot`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import ACTION_MEMORY, NUM_BINS, NUM_EARS, Batch, Chunk, States
from apex_bat.replay.sum_tree import SumTree

FRAME_VALUES = NUM_EARS * NUM_BINS
# One record an item, half a cache line: a draw of random items waits for memory once each and not once a field.
ITEM = np.dtype(
    [
        ("row", np.int64),  # number of the row at which it starts
        ("learner_step", np.int64),
        ("reward", np.float32),
        ("discount", np.float32),
        ("priority", np.float32),  # before the exponent
        ("actor", np.uint16),
        ("span", np.uint8),
        ("unused", np.uint8),
    ]
)
MAX_STEP = 255  # step numbers are kept up to this only: they tell the rows before an episode's start


class Sampled(NamedTuple):
    """A batch and what is known about its items beside."""

    batch: Batch
    actors: NDArray[np.uint16]
    """(batch,): index of the actor that made each."""
    learner_steps: NDArray[np.int64]
    """(batch,): updates that the actor's weights had seen."""
    largest_weight: float
    """By what the importance weights (N P(i))^-beta of the batch were divided."""


class BufferCounters(NamedTuple):
    """Where the rings stand."""

    first_item: int
    next_item: int
    next_row: int


class ReplayBuffer:
    """Prioritized replay of at most `capacity` transitions; the oldest go first, before new ones are added.

    Args:
        capacity: transitions.
        num_rows: echo frames; when they run out before `capacity` (short chunks), old transitions go earlier.
        memory_steps: frames in a state.
        heard_steps: how many of them, from the newest, are not blanked.
        alpha: exponent of the priorities.
    """

    def __init__(self, capacity: int, num_rows: int, memory_steps: int, heard_steps: int, alpha: float) -> None:
        self.capacity = capacity
        self.num_rows = num_rows
        self.memory_steps = memory_steps
        self.heard_steps = heard_steps
        self.context_rows = max(memory_steps - 1, ACTION_MEMORY)
        self.alpha = alpha
        self._frames = np.zeros((num_rows, FRAME_VALUES), np.float32)
        self._row_actions = np.zeros(num_rows, np.uint8)
        self._row_steps = np.zeros(num_rows, np.uint8)
        self._items = np.zeros(capacity, ITEM)
        self._tree = SumTree(capacity)
        self._first_item = 0
        self._next_item = 0
        self._next_row = 0

    def __len__(self) -> int:
        """Transitions held."""
        return self._next_item - self._first_item

    @property
    def counters(self) -> BufferCounters:
        """Where the rings stand: items ever added are `next_item`, items evicted are `first_item`."""
        return BufferCounters(self._first_item, self._next_item, self._next_row)

    @property
    def nbytes(self) -> int:
        """Memory of all arrays, bytes."""
        arrays = [*self.row_arrays().values(), *self.item_arrays().values()]
        return sum(array.nbytes for array in arrays) + self._tree.nbytes

    @property
    def total(self) -> float:
        """Sum of the priorities of all transitions held, after the exponent."""
        return self._tree.total

    def row_arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the rings of rows themselves (no copies). Row n stands at n % num_rows and never changes."""
        return {"frames": self._frames, "row_actions": self._row_actions, "row_steps": self._row_steps}

    def item_arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the ring of items itself (no copy). Item n stands at n % capacity."""
        return {"items": self._items}

    def check(self, chunks: Sequence[Chunk]) -> None:
        """Raises ValueError if chunks cannot be added together; the wire has checked all that a chunk must be."""
        rows, items = sum(len(chunk.frames) for chunk in chunks), sum(len(chunk.starts) for chunk in chunks)
        if rows > self.num_rows or items > self.capacity:
            raise ValueError(
                f"{rows} rows and {items} transitions at once are too many for {self.num_rows} and {self.capacity}"
            )
        for chunk in chunks:
            if chunk.first_step > 0 and len(chunk.starts) and chunk.starts[0] < self.context_rows:
                raise ValueError(
                    f"a chunk that begins at step {chunk.first_step} has {chunk.starts[0]} rows before its first "
                    f"transition; the state there needs {self.context_rows}"
                )

    def add(
        self, chunks: Sequence[Chunk], priorities: NDArray[np.float32], actor: int = 0, learner_step: int = 0
    ) -> None:
        """Adds the transitions of some chunks, all at once, and evicts the oldest for them.

        Args:
            chunks: what `check` has let pass.
            priorities: float32 (transitions of all chunks,), positive: what is drawn by, before the exponent.
            actor: index of the actor, below 65,536.
            learner_step: updates that its weights had seen.
        """
        num_rows, num_items = sum(len(chunk.frames) for chunk in chunks), len(priorities)
        freed = self._evict_for(num_rows, num_items)
        row, item = self._next_row % self.num_rows, self._next_item % self.capacity
        _write(self._frames, row, _joined([chunk.frames for chunk in chunks]).reshape(num_rows, FRAME_VALUES))
        _write(self._row_actions, row, _joined([chunk.actions for chunk in chunks]))
        _write(self._row_steps, row, _joined([_clipped_steps(chunk) for chunk in chunks]))
        firsts = accumulate((len(chunk.frames) for chunk in chunks[:-1]), initial=self._next_row)
        items = np.zeros(num_items, ITEM)
        items["row"] = _joined([chunk.starts + np.int64(first) for chunk, first in zip(chunks, firsts, strict=True)])
        items["learner_step"] = learner_step
        items["reward"] = _joined([chunk.rewards for chunk in chunks])
        items["discount"] = _joined([chunk.discounts for chunk in chunks])
        items["priority"] = priorities
        items["actor"] = actor
        items["span"] = _joined([chunk.spans for chunk in chunks])
        _write(self._items, item, items)
        positions = (self._next_item + np.arange(num_items)) % self.capacity
        leaves = np.concatenate([np.zeros(len(freed)), priorities.astype(np.float64) ** self.alpha])
        self._tree.set(np.concatenate([freed, positions]), leaves)
        self._next_row += num_rows
        self._next_item += num_items

    def sample(self, num_items: int, beta: float, generator: np.random.Generator) -> Sampled:
        """Returns transitions drawn in proportion to priority^alpha, in the order of their positions.

        The importance weights are (N P(i))^-beta (Schaul et al. 2016, eq. in section 3.4), divided by the greatest of
        this batch and not of the whole buffer: the buffer's is set by its least likely item, which hardly ever comes
        up, and would make the mean weight, and so the step size, 0.045 at a million items instead of 0.41 (measured).

        Raises:
            ValueError: the buffer is empty.
        """
        positions = self._tree.sample(num_items, generator)
        shares = self._tree.get(positions) / self._tree.total
        weights = (len(self) * shares) ** -beta
        largest_weight = float(weights.max())
        drawn = self._items.take(positions)
        rows = drawn["row"]
        states = self._states(np.concatenate([rows, rows + drawn["span"]]))
        batch = Batch(
            items=self._first_item + (positions - self._first_item) % self.capacity,
            weights=(weights / largest_weight).astype(np.float32),
            states=States(states.echoes[:num_items], states.actions[:num_items]),
            actions=self._row_actions[rows % self.num_rows],
            rewards=drawn["reward"],
            discounts=drawn["discount"],
            next_states=States(states.echoes[num_items:], states.actions[num_items:]),
        )
        return Sampled(batch, drawn["actor"], drawn["learner_step"], largest_weight)

    def update(self, items: NDArray[np.int64], priorities: NDArray[np.float32]) -> int:
        """Sets the priorities, positive, of items, and returns how many of these are gone and were left alone."""
        held = (items >= self._first_item) & (items < self._next_item)
        positions = items[held] % self.capacity
        self._items["priority"][positions] = priorities[held]
        self._tree.set(positions, priorities[held].astype(np.float64) ** self.alpha)
        return len(items) - len(positions)

    def some_priorities(self, most: int) -> NDArray[np.float32]:
        """Returns the priorities, before the exponent, of at most `most` items, evenly spread from oldest to newest."""
        held = np.arange(self._first_item, self._next_item, max(1, -(-len(self) // most)))
        priorities: NDArray[np.float32] = self._items["priority"].take(held % self.capacity)
        return priorities

    def set_alpha(self, alpha: float) -> None:
        """Changes the exponent, and with it the whole tree: tens of milliseconds at a million items."""
        if alpha != self.alpha:
            self.alpha = alpha
            self._rebuild()

    def restore(self, counters: BufferCounters) -> None:
        """Takes over counters after the rings were filled from a snapshot, and rebuilds the tree.

        Raises:
            ValueError: the counters or rings contradict each other; the buffer is empty then.
        """
        self._first_item, self._next_item, self._next_row = 0, 0, 0
        num_items = counters.next_item - counters.first_item
        if not 0 <= num_items <= self.capacity:
            raise ValueError(f"{num_items} items do not fit a capacity of {self.capacity}")
        held = np.arange(counters.first_item, counters.next_item) % self.capacity
        items = self._items[held]
        rows, spans, priorities = items["row"], items["span"], items["priority"]
        oldest_row = max(0, counters.next_row - self.num_rows)
        if len(held) and (rows.min() < oldest_row or (rows + spans).max() >= counters.next_row):
            raise ValueError("an item points at a row that is not there")
        if not (np.isfinite(priorities).all() and (priorities > 0).all()):
            raise ValueError("a priority is not positive")
        self._first_item, self._next_item, self._next_row = counters
        self._rebuild()

    def _rebuild(self) -> None:
        leaves = np.zeros(self.capacity)
        held = np.arange(self._first_item, self._next_item) % self.capacity
        leaves[held] = self._items["priority"][held].astype(np.float64) ** self.alpha
        self._tree.set_all(leaves)

    def _evict_for(self, num_rows: int, num_items: int) -> NDArray[np.int64]:
        """Makes room and returns positions that became free and stay so; the caller takes them out of the tree."""
        first = max(self._first_item, self._next_item + num_items - self.capacity)
        # Rows below this one are about to be overwritten; an item goes when its state reaches back to one of them.
        oldest_row = self._next_row + num_rows - self.num_rows
        while first < self._next_item and self._items["row"][first % self.capacity] - self.context_rows < oldest_row:
            window = np.arange(first, min(first + 256, self._next_item))
            lost = int(np.count_nonzero(self._items["row"][window % self.capacity] - self.context_rows < oldest_row))
            first += lost
        # The new items stand where the oldest of the evicted stood, and take their places in the tree, too.
        overwritten = self._next_item + num_items - self.capacity
        freed = np.arange(max(self._first_item, overwritten), first) % self.capacity
        self._first_item = first
        return freed

    def _states(self, rows: NDArray[np.int64]) -> States:
        """Returns the states at some rows; `experience.stack_state` does the same for a whole chunk."""
        # Indices by (how far back, row): small operations along a short last axis cost several times more (measured).
        places = rows % self.num_rows
        heard_back = np.arange(self.memory_steps - 1, -1, -1)[:, None]
        action_back = np.arange(ACTION_MEMORY, 0, -1)[:, None]
        # mode="wrap": rows before the ring's first are at its end; it also spares numpy a check of all indices.
        echoes = self._frames.take((places - heard_back).T, axis=0, mode="wrap")
        taken = self._row_actions.take((places - action_back).T, mode="wrap")
        echoes[:, : self.memory_steps - self.heard_steps] = 0.0
        steps = self._row_steps[places]
        early = np.flatnonzero(steps < self.context_rows)
        if len(early):
            where, when = np.nonzero(steps[early, None] < heard_back.T)
            echoes[early[where], when] = 0.0
            where, when = np.nonzero(steps[early, None] < action_back.T)
            taken[early[where], when] = 0
        return States(echoes.reshape(len(rows), self.memory_steps * NUM_EARS, NUM_BINS), taken)


def _write(ring: NDArray[Any], first: int, values: NDArray[Any]) -> None:
    """Writes values into a ring from a position on: two slices at most, several times cheaper than an index array."""
    before_end = min(len(values), len(ring) - first)
    ring[first : first + before_end] = values[:before_end]
    ring[: len(values) - before_end] = values[before_end:]


def _joined(arrays: list[NDArray[Any]]) -> NDArray[Any]:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _clipped_steps(chunk: Chunk) -> NDArray[np.int64]:
    return np.minimum(chunk.first_step + np.arange(len(chunk.frames)), MAX_STEP)
