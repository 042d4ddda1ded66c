"""What each part of a run costs in CPU time, each measured by itself: what `scaling_model` is fed with."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.config import Config
from apex_bat.experience import Chunk
from apex_bat.launching import ONE_THREAD
from apex_bat.replay.client import ReplayReader, ReplayWriter
from apex_bat.roles.actor import Actor
from apex_bat.roles.learner import device_of
from apex_bat.roles.plan import Addresses, Assignment, Role
from apex_bat.roles.reporting import RoleReporter
from apex_bat.roles.serial import BoardReader, WeightsBoard
from apex_bat.transport.messages import Report
from benchmarks.learner import batches_in_memory
from benchmarks.replay import Record, summary, synthetic_chunk
from benchmarks.scaling_model import Costs
from benchmarks.wire import ServerProcess, message_mb

ROUNDS = 3
ACTOR_STEPS = 150  # of 16 bats, a round
INSERTS = 1500  # of one chunk, a round
BATCHES = 200  # a round
FILL = 200  # chunks in the server before batches are drawn
UPDATES = 40  # a round, with batches of the first size; fewer with larger ones
CHUNK = 50
SIZES = (64, 512)  # of batches: two, so that what grows with the size is told from what does not


def measure_costs() -> list[Record]:
    """Returns CPU times of the parts, each by itself, and what goes over the wire; measured in a process of its own.

    That one has one thread: threads of the linear algebra that wait for work would be counted too.
    """
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.scaling_costs"], env=os.environ | dict.fromkeys(ONE_THREAD, "1"),
        stdout=subprocess.PIPE, text=True, check=True, timeout=600,
    )  # fmt: skip
    records: list[Record] = json.loads(done.stdout)
    return records


def costs_of(records: Sequence[Record]) -> Costs:
    """Returns the model's costs from the records of `measure_costs`."""
    us = {str(r["name"]).removeprefix("scaling.cost."): float(r["median"]) * 1e-6 for r in records}
    small, large = SIZES

    def line(part: str) -> tuple[float, float]:
        """Returns what does not grow with the size of a batch, and what each transition of it costs."""
        item_s = (us[f"{part}_{large}_us"] - us[f"{part}_{small}_us"]) / (large - small)
        return us[f"{part}_{small}_us"] - small * item_s, item_s

    return Costs(us["step_us"] + us["send_us"] / CHUNK, us["insert_us"], *line("batch"), *line("update"), *line("take"))


def _costs() -> list[Record]:
    records = [summary("scaling.cost.step_us", "us", _actor_us())]
    inserts, sends = _insert_us()
    records += [summary("scaling.cost.insert_us", "us", inserts), summary("scaling.cost.send_us", "us", sends)]
    for size in SIZES:
        batches, takes = _batch_us(size)
        records.append(summary(f"scaling.cost.batch_{size}_us", "us", batches))
        records.append(summary(f"scaling.cost.take_{size}_us", "us", takes))
        records.append(summary(f"scaling.cost.update_{size}_us", "us", _update_us(size)))
    transition_mb, batch_mb = message_mb(SIZES[0])
    records.append(summary("scaling.wire.transition_bytes", "B", [transition_mb * 1e6]))
    records.append(summary("scaling.wire.batch_64_bytes", "B", [batch_mb * 1e6]))
    weights = D3QN(Config(), torch.device("cpu")).weights()
    records.append(summary("scaling.wire.weights_bytes", "B", [float(sum(array.nbytes for array in weights.values()))]))
    return records


class _Sink:
    """Takes an actor's chunks and forgets them."""

    waiting = ""
    has_room = True

    def send(self, chunks: Sequence[Chunk], learner_step: int) -> None:
        """Forgets."""

    def poll(self, timeout_s: float) -> None:
        """Does nothing."""

    def flush(self, timeout_s: float) -> bool:
        """Returns True: nothing is under way."""
        del timeout_s
        return True

    def counters(self) -> dict[str, float]:
        """There are none."""
        return {}

    def close(self) -> None:
        """Does nothing."""


class _Line:
    """Takes reports and forgets them."""

    def send(self, report: Report) -> None:
        """Forgets."""

    def close(self) -> None:
        """Does nothing."""


def _actor_us() -> list[float]:
    """Returns CPU of an actor for each environment step."""
    config, board = Config(), WeightsBoard()
    torch.set_num_threads(1)
    board.publish(1, 0, D3QN(config, torch.device("cpu")).weights())
    with tempfile.TemporaryDirectory() as folder:
        assignment = Assignment(
            Role("actor", 1), config, Path(folder), Addresses("", "", ""), threading.Event(), 0
        )  # not the first: that one records flights
        actor = Actor(assignment, _Sink(), BoardReader(board), RoleReporter(assignment, line=_Line()))
        try:
            values = []
            for number in range(ROUNDS + 1):
                begun_s = time.process_time()
                for _ in range(ACTOR_STEPS):
                    actor.is_ready(0.0)
                    actor.step()
                values.append((time.process_time() - begun_s) / (ACTOR_STEPS * config.bats_per_actor) * 1e6)
                del number
            return values[1:]  # the first round warms up
        finally:
            actor.close()


def _insert_us() -> tuple[list[float], list[float]]:
    """Returns CPU of a server, and of who sends, for each insert of one chunk."""
    chunk = synthetic_chunk(np.random.default_rng(0))
    served, sent = [], []
    with ServerProcess(None) as server:
        writer = ReplayWriter(server.address, "actor", Config().actor.window_chunks)  # as many as the server queues
        for _ in range(ROUNDS):
            server_s, own_s = server.cpu_s(), time.process_time()
            for _ in range(INSERTS):
                while not writer.has_room:
                    writer.poll(0.1)
                writer.send([chunk], 0)
            while not writer.flush(1.0):
                pass
            served.append((server.cpu_s() - server_s) / INSERTS * 1e6)
            sent.append((time.process_time() - own_s) / INSERTS * 1e6)
        writer.close()
    return served, sent


def _batch_us(size: int) -> tuple[list[float], list[float]]:
    """Returns CPU of a server, and of who takes it, for each batch and the new priorities of its items."""
    chunk = synthetic_chunk(np.random.default_rng(0))
    served, taken = [], []
    with ServerProcess(None, size) as server:
        writer = ReplayWriter(server.address, "actor", 64)
        for _ in range(FILL):
            writer.send([chunk], 0)
            while not writer.flush(1.0):
                pass
        writer.close()
        reader = ReplayReader(server.address, size, 16)
        for _ in range(ROUNDS):
            server_s, own_s = server.cpu_s(), time.process_time()
            left = BATCHES
            while left:
                batch = reader.next(10.0)
                if batch is None:
                    raise RuntimeError(f"no batch within 10 s: {reader.waiting}")
                reader.update(batch.items, batch.weights)
                left -= 1
            served.append((server.cpu_s() - server_s) / BATCHES * 1e6)
            taken.append((time.process_time() - own_s) / BATCHES * 1e6)
        reader.close()
    return served, taken


def _update_us(size: int) -> list[float]:
    """Returns CPU of the learner for an update."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    agent = D3QN(Config(), device_of("cpu"))
    batches = batches_in_memory(size, 8)
    updates = UPDATES * SIZES[0] // size
    values = []
    for _ in range(ROUNDS + 1):
        begun_s = time.process_time()
        for number in range(updates):
            agent.update(batches[number % len(batches)])
        values.append((time.process_time() - begun_s) / updates * 1e6)
    return values[1:]


if __name__ == "__main__":
    print(json.dumps(_costs()))
