"""Times of the replay core, in process, in microseconds of CPU, beside cpprb's where that is installed.

Run it with `apex-bat bench replay` or `python -m benchmarks.replay`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from itertools import cycle
from typing import Any, ClassVar

import numpy as np

from apex_bat.experience import NO_ACTION, Chunk
from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.heap import keep_freed_memory

CAPACITIES = (50_000, 1_000_000)
BATCHES = (32, 512)
INSERT = 50  # transitions at once
BLOCKS = 20  # of cpprb's, in turn: what is inserted again and again would lie in the cache
ROWS_EACH = 1.232  # of a transition, as the store reserves them for chunks of 50
RUNS = 200

Record = dict[str, str | float | int]


def measure() -> list[Record]:
    """Returns the records that `apex-bat bench replay` writes."""
    keep_freed_memory()  # as the server does
    records: list[Record] = []
    for capacity in CAPACITIES:
        records += _of_capacity(capacity)
    return records


def summary(name: str, unit: str, values: list[float]) -> Record:
    """Returns a record of repeated measurements."""
    figures = np.array(values)
    return {
        "name": name,
        "unit": unit,
        "median": float(np.median(figures)),
        "min": float(figures.min()),
        "max": float(figures.max()),
        "runs": len(values),
    }


def synthetic_chunk(generator: np.random.Generator, transitions: int = 50) -> Chunk:
    """Returns a chunk from the middle of an episode, with 3 rows of context and spans of 3."""
    rows = transitions + 6
    actions = generator.integers(0, 3, rows).astype(np.uint8)
    actions[-1] = NO_ACTION
    rewards, discounts, priorities = (generator.random(transitions, dtype=np.float32) for _ in range(3))
    return Chunk(
        first_step=20,
        frames=generator.random((rows, 2, 24), dtype=np.float32),
        actions=actions,
        starts=np.arange(3, transitions + 3, dtype=np.uint16),
        spans=np.full(transitions, 3, np.uint8),
        rewards=rewards,
        discounts=discounts,
        priorities=priorities,
    )


def _of_capacity(capacity: int) -> list[Record]:
    end = f"cap_{capacity}"
    ours, theirs = Filled(capacity), _cpprb(capacity)
    records: list[Record] = []
    for name, size in (("insert", INSERT), *((name, size) for size in BATCHES for name in ("sample", "update"))):
        operations = [getattr(ours, name)(size)]
        if theirs is not None:
            operations.append(getattr(theirs, name)(size))
        ours_us, *rest = _cpu_us(operations)
        records.append(summary(f"replay.{name}_{size}.{end}.cpu_us", "us", ours_us))
        for theirs_us in rest:
            ratios = [mine / other for mine, other in zip(ours_us, theirs_us, strict=True)]
            records.append(summary(f"replay.{name}_{size}.{end}.cpprb_cpu_us", "us", theirs_us))
            records.append(summary(f"replay.{name}_{size}.{end}.ratio_to_cpprb", "1", ratios))
    records.append(summary(f"replay.resident_mb.{end}", "MB", [ours.buffer.nbytes / 1e6]))
    return records


def _cpu_us(operations: list[Callable[[], object]]) -> list[list[float]]:
    """Returns the CPU times of some operations, taken in turn, so that a noisy moment meets all of them."""
    times: list[list[float]] = [[] for _ in operations]
    for _ in range(RUNS):
        for operation, own in zip(operations, times, strict=True):
            begun = time.thread_time_ns()
            operation()
            own.append((time.thread_time_ns() - begun) / 1000)
    return times


class Filled:
    """A full buffer and the operations on it; each method returns one that is ready to be timed."""

    def __init__(self, capacity: int) -> None:
        self.generator = np.random.default_rng(0)
        self.buffer = ReplayBuffer(capacity, int(capacity * ROWS_EACH), memory_steps=3, heard_steps=3, alpha=0.6)
        insert = self.insert(INSERT)
        for _ in range(capacity // INSERT + 1):
            insert()

    def insert(self, size: int) -> Callable[[], object]:
        """Returns what inserts so many transitions."""
        chunks = cycle([synthetic_chunk(self.generator, size) for _ in range(RUNS)])
        return lambda: self._add(next(chunks))

    def _add(self, chunk: Chunk) -> None:
        self.buffer.add([chunk], chunk.priorities + np.float32(0.001), 0, 0)

    def sample(self, size: int) -> Callable[[], object]:
        """Returns what draws so many."""
        return lambda: self.buffer.sample(size, 0.4, self.generator)

    def update(self, size: int) -> Callable[[], object]:
        """Returns what gives so many new priorities."""
        drawn = cycle([self.buffer.sample(size, 0.4, self.generator).batch.items for _ in range(RUNS)])
        errors = self.generator.random(size, dtype=np.float32) + np.float32(0.001)
        return lambda: self.buffer.update(next(drawn), errors)


class _Cpprb:
    """The same of cpprb, which holds both states of each transition."""

    FIELDS: ClassVar[dict[str, dict[str, Any]]] = {
        "echoes": {"shape": (6, 24)},
        "next_echoes": {"shape": (6, 24)},
        "taken": {"shape": 3, "dtype": np.uint8},
        "next_taken": {"shape": 3, "dtype": np.uint8},
        "action": {"dtype": np.uint8},
        "reward": {},
        "discount": {},
    }

    def __init__(self, module: Any, capacity: int) -> None:
        self.generator = np.random.default_rng(0)
        self.buffer = module.PrioritizedReplayBuffer(capacity, self.FIELDS, alpha=0.6)
        insert = self.insert(500)
        for _ in range(capacity // 500):
            insert()

    def insert(self, size: int) -> Callable[[], object]:
        priorities = self.generator.random(size)
        blocks = cycle([self._block(size) for _ in range(BLOCKS)])
        return lambda: self.buffer.add(**next(blocks), priorities=priorities)

    def _block(self, size: int) -> dict[str, Any]:
        return {
            name: self.generator.random((size, *np.atleast_1d(field.get("shape", 1)))).astype(np.float32)
            for name, field in self.FIELDS.items()
        }

    def sample(self, size: int) -> Callable[[], object]:
        """Returns what draws so many."""
        return lambda: self.buffer.sample(size, beta=0.4)

    def update(self, size: int) -> Callable[[], object]:
        """Returns what gives so many new priorities."""
        drawn = cycle([self.buffer.sample(size, beta=0.4)["indexes"] for _ in range(RUNS)])
        priorities = self.generator.random(size)
        return lambda: self.buffer.update_priorities(next(drawn), priorities)


def _cpprb(capacity: int) -> _Cpprb | None:
    """Returns a full buffer of cpprb; None where it is not installed."""
    try:
        import cpprb  # type: ignore[import-not-found]
    except ImportError:
        return None
    return _Cpprb(cpprb, capacity)


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
