"""Updates per second of the learner on the real replay server, beside the same network on batches in memory.

Both are measured in turn, in one run. Run it with `apex-bat bench learner` or `python -m benchmarks.learner`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from itertools import cycle

import numpy as np
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.config.settings import Config
from apex_bat.experience import Batch
from apex_bat.replay.client import ReplayReader, ReplayWriter
from apex_bat.roles.learner import device_of
from benchmarks.replay import Record, summary, synthetic_chunk
from benchmarks.wire import ServerProcess

ROUNDS = 5
MEASURED_S = 4.0
FILL = 20_000  # transitions in the server
IN_MEMORY = 32  # batches that the other learner takes in turn
PREFETCH = 16
BATCH_SIZES = (64, 512)


def measure() -> list[Record]:
    """Returns the records that `apex-bat bench learner` writes; those without a size are of the default batch."""
    default, *others = BATCH_SIZES
    records = _measure(default, "learner")
    for size in others:
        records += _measure(size, f"learner.batch_{size}")
    return records


def _measure(batch_size: int, name: str) -> list[Record]:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    agent = D3QN(Config(), device_of("auto"))
    served, in_memory, idle = [], [], []
    with ServerProcess(None, batch_size) as server:
        _fill(server.address)
        reader = ReplayReader(server.address, batch_size, PREFETCH)
        turn = cycle(_some(reader, IN_MEMORY))
        for _ in range(ROUNDS):
            in_memory.append(_updates_per_s(agent, lambda: next(turn), None))
            waited_s = reader.waited_s
            served.append(_updates_per_s(agent, lambda: reader.next(10.0), reader))
            idle.append((reader.waited_s - waited_s) / MEASURED_S)
        reader.close()
    relative = [ours / theirs for ours, theirs in zip(served, in_memory, strict=True)]
    return [
        summary(f"{name}.updates_per_s", "1/s", served),
        summary(f"{name}.in_memory.updates_per_s", "1/s", in_memory),
        summary(f"{name}.relative_updates", "1", relative),
        summary(f"{name}.idle_share", "1", idle),
    ]


def batches_in_memory(batch_size: int, number: int) -> list[Batch]:
    """Returns batches of synthetic transitions, from a server."""
    with ServerProcess(None, batch_size) as server:
        _fill(server.address)
        reader = ReplayReader(server.address, batch_size, PREFETCH)
        try:
            return _some(reader, number)
        finally:
            reader.close()


def _some(reader: ReplayReader, number: int) -> list[Batch]:
    batches = [batch for _ in range(number) if (batch := reader.next(10.0)) is not None]
    if len(batches) < number:
        raise RuntimeError(f"the server gave {len(batches)} batches within 10 s each: {reader.waiting}")
    return batches


def _fill(address: str) -> None:
    generator = np.random.default_rng(0)
    writer = ReplayWriter(address, "filler", 64)
    sent = 0
    while sent < FILL:
        chunk = synthetic_chunk(generator)
        writer.send([chunk], 0)
        sent += len(chunk.starts)
        while not writer.flush(1.0):
            pass
    writer.close()


def _updates_per_s(agent: D3QN, next_batch: Callable[[], Batch | None], reader: ReplayReader | None) -> float:
    """Returns the rate of whole updates; with a reader, the new priorities go back."""
    begun_s = time.perf_counter()
    num_updates = 0
    while time.perf_counter() - begun_s < MEASURED_S:
        batch = next_batch()
        if batch is None:
            continue
        update = agent.update(batch)
        if reader is not None:
            reader.update(batch.items, np.abs(update.errors))
        num_updates += 1
    return num_updates / (time.perf_counter() - begun_s)


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
