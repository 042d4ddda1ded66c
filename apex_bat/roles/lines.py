"""What the roles need of one another, whatever carries it: ZeroMQ between processes, plain calls in one process.

`apex_bat.replay.client` and `apex_bat.transport.weights` hold the ZeroMQ ends; tests and the serial mode have others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import Batch, Chunk
from apex_bat.transport.messages import Weights


class ExperienceSink(Protocol):
    """Where an actor's chunks go."""

    @property
    def waiting(self) -> str:
        """For whom the replay waits; empty when it stores at once."""

    @property
    def has_room(self) -> bool:
        """Whether `send` may be called."""

    def send(self, chunks: Sequence[Chunk], learner_step: int) -> None:
        """Sends chunks flown with the weights of a learner step."""

    def poll(self, timeout_s: float) -> None:
        """Handles what came back, waiting at most so long."""

    def flush(self, timeout_s: float) -> bool:
        """Waits until all is stored, at most so long; says whether it is."""

    def counters(self) -> dict[str, float]:
        """Returns the sink's figures."""

    def close(self) -> None:
        """Ends the line."""


class WeightsSource(Protocol):
    """Where an actor's weights come from."""

    def newest(self) -> Weights | None:
        """Returns weights that came since the last call, or None."""

    def wait(self, timeout_s: float) -> bool:
        """Waits until something came, at most so long."""

    def close(self) -> None:
        """Ends the line."""


class BatchSource(Protocol):
    """Where the learner's batches come from and its priorities go."""

    @property
    def waiting(self) -> str:
        """Why there is no batch; empty when there is one."""

    def next(self, timeout_s: float) -> Batch | None:
        """Returns a batch, or None if none came in time."""

    def update(self, items: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Sends new |TD errors| of items."""

    def counters(self) -> dict[str, float]:
        """Returns the source's figures."""

    def close(self) -> None:
        """Ends the line."""


class WeightsSink(Protocol):
    """Where the learner's weights go."""

    def publish(self, version: int, learner_step: int, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        """Broadcasts weights."""

    def serve(self) -> None:
        """Serves who came late."""

    def close(self) -> None:
        """Ends the line."""
