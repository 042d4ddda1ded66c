"""A live replay server under every attack: the good ones are served, what is bad is counted, nothing is lost."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import zmq

from apex_bat.config.settings import Config
from apex_bat.experience import Chunk
from apex_bat.replay.client import ReplayReader, ReplayWriter
from apex_bat.replay.server import ReplayServer
from benchmarks.attacks import ON_REPLAY, Target

MakeChunk = Callable[..., Chunk]

GENERATION = 987_654_321
SHOTS = 5
INSERTS = 60
EXPECTED = {"foreign", "size", "protocol", "generation", "shape", "parts", "value", "batch_size", "unexpected"}


def attack(target: Target) -> None:
    """A process: every attack a few times, then waits to be ended, so that what it sent is not dropped."""
    shots = [make(target) for make in ON_REPLAY.values()]
    for _ in range(SHOTS):
        for shoot in shots:
            shoot()
    multiprocessing.Event().wait()


def test_all_are_served_while_every_attack_goes_on(config: Config, make_chunk: MakeChunk, tmp_path: Path) -> None:
    small = msgspec.structs.replace(
        config,
        transport=msgspec.structs.replace(config.transport, max_message_mb=0.25),
        replay=msgspec.structs.replace(config.replay, never_block=True),
    )
    server = ReplayServer(
        small, "tcp://127.0.0.1:0", np.random.default_rng(0), tmp_path / "replay", generation=GENERATION
    )
    writer = ReplayWriter(server.address, "good", 8, generation=GENERATION)
    reader = ReplayReader(server.address, 16, 2, generation=GENERATION)
    target = Target(server.address, GENERATION, small.transport.max_message_bytes, zmq.DEALER)
    attacker = multiprocessing.get_context("spawn").Process(target=attack, args=(target,), daemon=True)
    attacker.start()
    sent, batches = 0, 0

    def work() -> None:
        nonlocal sent, batches
        if sent < INSERTS and writer.has_room:
            writer.send([make_chunk(10)], 0)
            sent += 1
        writer.poll(0.0)
        batch = reader.next(0.001)
        if batch is not None:
            batches += 1
            reader.update(batch.items, np.ones(len(batch.items), np.float32))

    def is_all_counted() -> bool:
        figures = server.metrics()
        return (
            set(server.refusals) >= EXPECTED | {"handshake"}
            and all(server.refusals[reason] >= SHOTS for reason in EXPECTED)
            and figures["replay.duplicates"] >= SHOTS - 1
            and figures["replay.late_priorities"] >= SHOTS
            and figures["replay.ended_connections"] >= SHOTS
        )

    try:
        ends_s = time.monotonic() + 60.0  # a process is started in it, on a machine that may be busy
        while not (writer.acknowledged == 10 * INSERTS and batches >= 20 and is_all_counted()):
            assert time.monotonic() < ends_s, (server.refusals, writer.counters(), batches)
            work()
            server.serve(0.001)
        figures = server.metrics()
        assert writer.refused == 0
        assert server.store.actor_shares().keys() <= {"good", "hostile"}
        assert figures["replay.inserted"] in (10 * INSERTS, 10 * INSERTS + 50)  # the hostile insert that is right: once
        assert figures["replay.refused_messages"] == sum(server.refusals.values())
        assert all(figures[f"replay.refused_messages.{r}"] == n for r, n in server.refusals.items())
    finally:
        attacker.kill()
        attacker.join()
        writer.close()
        reader.close()
        server.close()
