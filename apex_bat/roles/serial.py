"""The lines of the serial mode: what ZeroMQ carries between processes is here a call of the other side.

Nothing is under way: an insert is stored, a batch drawn and a priority set at once, weights lie ready for who looks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import Batch, Chunk
from apex_bat.replay.store import RefusedChunkError, ReplayStore
from apex_bat.storage import State
from apex_bat.transport.messages import Weights


class StoreSink:
    """An actor's end of a replay in the same process."""

    waiting = "the learner is to go on first"

    def __init__(self, store: ReplayStore, actor: str) -> None:
        self._store, self._actor = store, actor
        self._sent = self._refused = 0

    @property
    def has_room(self) -> bool:
        """Whether the rate limiter would let in the most that a step can bring."""
        return not self._store.limiter.holds_back_inserts

    def send(self, chunks: Sequence[Chunk], learner_step: int) -> None:
        """Stores chunks flown with the weights of a learner step."""
        size = sum(len(chunk.starts) for chunk in chunks)
        self._sent += size
        try:
            self._store.add(self._actor, learner_step, chunks)
        except RefusedChunkError:
            self._refused += size

    def poll(self, timeout_s: float) -> None:
        """Does nothing: everything was answered at once."""
        del timeout_s

    def flush(self, timeout_s: float) -> bool:
        """Returns True: everything is stored."""
        del timeout_s
        return True

    def counters(self) -> dict[str, float]:
        """Returns the figures of `replay.metrics.WRITER_METRICS` that exist without a wire."""
        return {
            "writer.sent": self._sent,
            "writer.acknowledged": self._sent - self._refused,
            "writer.refused": self._refused,
        }

    def state(self) -> State:
        """Returns the counters."""
        return State({"sent": self._sent, "refused": self._refused}, {})

    def restore(self, state: State) -> None:
        """Continues from what `state` returned."""
        self._sent, self._refused = state.values["sent"], state.values["refused"]

    def close(self) -> None:
        """Does nothing."""


class StoreSource:
    """The learner's end of a replay in the same process. Each batch is drawn when it is used."""

    def __init__(self, store: ReplayStore, batch_size: int) -> None:
        self._store, self._batch_size = store, batch_size
        self._received = 0
        self._learner_step = 0

    @property
    def is_owed(self) -> bool:
        """Whether the learner's turn has come: inserts have earned a batch, or no more may come before one is drawn.

        So the samples per insert stay at their ratio, and not at an edge of the rate limiter's band.
        """
        limiter = self._store.limiter
        is_earned = limiter.balance >= self._batch_size or limiter.holds_back_inserts
        return is_earned and self._store.can_sample(self._batch_size)

    @property
    def waiting(self) -> str:
        """Why there is no batch; empty when there is one."""
        return "" if self.is_owed else self._store.limiter.waiting_reason() or "the actors are to go on first"

    def next(self, timeout_s: float) -> Batch | None:
        """Returns a batch, or None where the rate limiter lets none out."""
        del timeout_s
        if not self._store.can_sample(self._batch_size):
            return None
        self._received += 1
        batch = self._store.sample(self._batch_size, self._learner_step)
        self._store.count_sample(self._batch_size)
        return batch

    def update(self, items: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Sets new |TD errors| of items."""
        self._learner_step += 1
        self._store.update(self._learner_step, items, priorities)

    def counters(self) -> dict[str, float]:
        """Returns the figures of `replay.metrics.READER_METRICS` that exist without a wire."""
        return {"reader.received": self._received}

    def state(self) -> State:
        """Returns the counters."""
        return State({"received": self._received, "learner_step": self._learner_step}, {})

    def restore(self, state: State) -> None:
        """Continues from what `state` returned."""
        self._received, self._learner_step = state.values["received"], state.values["learner_step"]

    def close(self) -> None:
        """Does nothing."""


class WeightsBoard:
    """Where the learner puts its weights, and actors find them; only the newest are kept."""

    def __init__(self) -> None:
        self.newest: Weights | None = None

    def publish(self, version: int, learner_step: int, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        """Puts weights there, for which nobody else holds the arrays."""
        self.newest = Weights(version, learner_step, dict(arrays))

    def serve(self) -> None:
        """Does nothing: who comes late finds the newest."""

    def state(self) -> State:
        """Returns the weights."""
        if self.newest is None:
            return State({}, {})
        version, learner_step, arrays = self.newest
        return State({"version": version, "learner_step": learner_step}, dict(arrays))

    def restore(self, state: State) -> None:
        """Continues from what `state` returned."""
        values = state.values
        self.newest = Weights(values["version"], values["learner_step"], dict(state.arrays)) if values else None

    def close(self) -> None:
        """Does nothing."""


class BoardReader:
    """An actor's look at the board."""

    def __init__(self, board: WeightsBoard) -> None:
        self._board = board
        self._taken = 0  # version; the learner's first is 1

    def newest(self) -> Weights | None:
        """Returns weights that came since the last call, or None."""
        weights = self._board.newest
        if weights is None or weights.version == self._taken:
            return None
        self._taken = weights.version
        return weights

    def wait(self, timeout_s: float) -> bool:
        """Returns whether there are weights; nothing would come while somebody waits."""
        del timeout_s
        return self._board.newest is not None

    def state(self) -> State:
        """Returns which weights were taken."""
        return State({"taken": self._taken}, {})

    def restore(self, state: State) -> None:
        """Continues from what `state` returned."""
        self._taken = state.values["taken"]

    def close(self) -> None:
        """Does nothing."""
