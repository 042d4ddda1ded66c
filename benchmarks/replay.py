"""Times of the replay core, in process, in microseconds of CPU: inserts of 50, samples and updates of 512.

Run it with `apex-bat bench replay` or `python -m benchmarks.replay`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from apex_bat.experience import NO_ACTION, Chunk
from apex_bat.replay.buffer import ReplayBuffer
from apex_bat.replay.heap import keep_freed_memory

CAPACITIES = (50_000, 1_000_000)
BATCHES = (32, 512)
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
    generator = np.random.default_rng(0)
    buffer = ReplayBuffer(capacity, int(capacity * ROWS_EACH), memory_steps=3, heard_steps=3, alpha=0.6)
    chunk = synthetic_chunk(generator)
    priorities = chunk.priorities + np.float32(0.001)

    def insert() -> None:
        buffer.add([chunk], priorities, 0, 0)

    for _ in range(capacity // 50 + 1):
        insert()
    end = f"cap_{capacity}"
    records = [summary(f"replay.insert_50.{end}.cpu_us", "us", _cpu_us(insert))]
    for size in BATCHES:
        items = buffer.sample(size, 0.4, generator).batch.items
        errors = generator.random(size, dtype=np.float32) + np.float32(0.001)
        sampled = _cpu_us(lambda size=size: buffer.sample(size, 0.4, generator))  # type: ignore[misc]
        updated = _cpu_us(lambda items=items, errors=errors: buffer.update(items, errors))  # type: ignore[misc]
        records.append(summary(f"replay.sample_{size}.{end}.cpu_us", "us", sampled))
        records.append(summary(f"replay.update_{size}.{end}.cpu_us", "us", updated))
    ratio = _ratio_to_cpprb(capacity, lambda: buffer.sample(512, 0.4, generator))
    if ratio is not None:
        records.append(summary(f"replay.sample_512.{end}.ratio_to_cpprb", "1", ratio))
    records.append(summary(f"replay.resident_mb.{end}", "MB", [buffer.nbytes / 1e6]))
    return records


def _cpu_us(operation: Callable[[], object]) -> list[float]:
    times = []
    for _ in range(RUNS):
        begun = time.thread_time_ns()
        operation()
        times.append((time.thread_time_ns() - begun) / 1000)
    return times


def _ratio_to_cpprb(capacity: int, sample: Callable[[], object]) -> list[float] | None:
    """Returns the ratios of our time to cpprb's, in turns; None where cpprb is not installed."""
    try:
        import cpprb  # type: ignore[import-not-found]
    except ImportError:
        return None
    fields: dict[str, dict[str, Any]] = {
        "echoes": {"shape": (6, 24)},
        "next_echoes": {"shape": (6, 24)},
        "taken": {"shape": 3, "dtype": np.uint8},
        "next_taken": {"shape": 3, "dtype": np.uint8},
        "action": {"dtype": np.uint8},
        "reward": {},
        "discount": {},
    }
    theirs = cpprb.PrioritizedReplayBuffer(capacity, fields, alpha=0.6)
    generator = np.random.default_rng(0)
    block = {
        name: generator.random((500, *np.atleast_1d(field.get("shape", 1)))).astype(np.float32)
        for name, field in fields.items()
    }
    for _ in range(capacity // 500):
        theirs.add(**block, priorities=generator.random(500))
    ours_us: list[float] = []
    theirs_us: list[float] = []
    for _ in range(RUNS):
        for operation, times in ((sample, ours_us), (lambda: theirs.sample(512, beta=0.4), theirs_us)):
            begun = time.thread_time_ns()
            operation()
            times.append((time.thread_time_ns() - begun) / 1000)
    return [ours / other for ours, other in zip(ours_us, theirs_us, strict=True)]


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
