"""The other ends of a role's lines, in the same process; each checks what it is given."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from apex_bat.agent.network import DuelingNetwork, parameters_of
from apex_bat.config import Config
from apex_bat.experience import Batch, Chunk, States
from apex_bat.roles.plan import Addresses, Assignment, Role
from apex_bat.transport.messages import Weights

BATCH = 16
LEARNER_STEP = 5
"""That of all weights that `FakeWeights` gives."""


def assignment(config: Config, folder: Path, role: Role) -> Assignment:
    """A role's part of a run whose sockets lie in a folder."""
    addresses = Addresses(*(f"ipc://{folder}/{name}" for name in ("replay", "weights", "reports")))
    return Assignment(role, config, folder, addresses, threading.Event(), 0)


class FakeReplay:
    """An actor's end of a replay: always has room, and keeps the chunks."""

    waiting = ""
    has_room = True

    def __init__(self) -> None:
        self.chunks: list[Chunk] = []

    def send(self, chunks: Sequence[Chunk], learner_step: int) -> None:
        assert learner_step >= 0
        self.chunks += chunks

    def poll(self, timeout_s: float) -> None:
        assert timeout_s >= 0.0

    def flush(self, timeout_s: float) -> bool:
        return timeout_s >= 0.0

    def counters(self) -> dict[str, float]:
        return {}

    def close(self) -> None:
        return None


class Batches:
    """A learner's end of a replay: the same batches, in order, to whoever begins at the same number."""

    waiting = ""

    def __init__(self, number: int) -> None:
        self.number = number

    def next(self, timeout_s: float) -> Batch:
        assert timeout_s >= 0.0
        generator = np.random.default_rng(self.number)
        self.number += 1
        actions = generator.integers(0, 3, (BATCH, 3)).astype(np.uint8)
        states, next_states = (States(generator.random((BATCH, 6, 24), np.float32), actions) for _ in range(2))
        numbers = generator.random((3, BATCH), np.float32)
        return Batch(np.arange(BATCH), numbers[0], states, actions[:, 0], numbers[1], 0.9 * numbers[2], next_states)

    def update(self, items: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        assert items.shape == priorities.shape

    def counters(self) -> dict[str, float]:
        return {}

    def close(self) -> None:
        return None


class FakeWeights:
    """Both ends of the weights: gives those of an untrained network whenever asked, takes others, and counts both."""

    def __init__(self, config: Config) -> None:
        torch.manual_seed(0)
        self._arrays = parameters_of(DuelingNetwork(config.network, config.state_steps))
        self.num_asked = self.num_published = 0

    def newest(self) -> Weights:
        self.num_asked += 1
        return Weights(self.num_asked, LEARNER_STEP, self._arrays)

    def wait(self, timeout_s: float) -> bool:
        return timeout_s >= 0.0

    def publish(self, version: int, learner_step: int, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        assert version > 0
        assert learner_step >= 0
        assert arrays.keys() == self._arrays.keys()
        self.num_published += 1

    def serve(self) -> None:
        return None

    def close(self) -> None:
        return None
