"""Rates and delays of the replay server and the weights through real sockets, between real processes.

Run it with `apex-bat bench wire` or `python -m benchmarks.wire`.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import tempfile
import time
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event
from pathlib import Path

import msgspec
import numpy as np
import psutil

from apex_bat.config.settings import Config, Learner, Replay
from apex_bat.replay.client import ReplayReader, ReplayWriter
from apex_bat.replay.server import ReplayServer
from apex_bat.replay.store import ReplayStore
from apex_bat.transport.messages import Insert, Sample, encode
from apex_bat.transport.security import Keys, make_keys
from apex_bat.transport.weights import WeightsPublisher, WeightsSubscriber
from benchmarks.replay import Record, summary, synthetic_chunk

WARM_UP_S = 1.0
MEASURED_S = 3.0
ROUNDS = 3
CHUNKS_AT_ONCE = 16  # the chunks of 16 bats that fly in step are complete at the same time
BATCH_SIZE = 512
CAPACITY = 200_000
INSERTS = 1000
WARM_UP_INSERTS = 50
BROADCASTS = 50
SUBSCRIBERS = 8

_processes = multiprocessing.get_context("spawn")


def measure() -> list[Record]:
    """Returns the records that `apex-bat bench wire` writes."""
    _leave_out_warnings()
    with tempfile.TemporaryDirectory() as folder:
        keys = make_keys(Path(folder) / "keys")
        records: list[Record] = []
        for end, own in (("", None), (".curve", keys)):
            records += _insert_delays(f"wire.insert_50{end}", own)
            records += _sample_delays(f"wire.sample_512{end}", own)
            records += _weights_delays(f"wire.weights_8{end}.max_ms", own)
        for num_actors, batch_size, own, name in (
            (4, 512, None, "wire.server"),
            (1, 512, None, "wire.server.actors_1"),
            (16, 512, None, "wire.server.actors_16"),
            (4, 32, None, "wire.server.batch_32"),
            (4, 512, keys, "wire.server.curve"),
        ):
            records += _saturated(name, num_actors, batch_size, own)
        return records


def _leave_out_warnings() -> None:
    """Leaves out that others of this machine can connect: it is measured on loopback, for some seconds."""
    logging.getLogger("apex_bat.transport.sockets").setLevel(logging.ERROR)


def _settings(capacity: int, batch_size: int) -> Config:
    replay = Replay(capacity=capacity, never_block=True, snapshot_period_s=0.0)
    return msgspec.structs.replace(Config(), replay=replay, learner=Learner(batch_size=batch_size))


def _serve(
    addresses: Queue[str],
    figures: Queue[dict[str, float]],
    begin: Event,
    stop: Event,
    keys: Keys | None,
    batch_size: int,
) -> None:
    """A process: serves until told to stop, and gives its rates since it was told to begin measuring."""
    _leave_out_warnings()
    server = ReplayServer(_settings(CAPACITY, batch_size), "tcp://127.0.0.1:0", np.random.default_rng(0), keys=keys)
    addresses.put(server.address)
    begun_s, first = time.monotonic(), server.metrics()
    is_measured = False
    while not stop.is_set():
        server.serve(0.05)
        if not is_measured and begin.is_set():
            begun_s, first = time.monotonic(), server.metrics()
            is_measured = True
    elapsed_s, last = time.monotonic() - begun_s, server.metrics()
    figures.put({name: (last[name] - first[name]) / elapsed_s for name in ("replay.inserted", "replay.sampled")})
    server.close()


class ServerProcess:
    """A server process and what is shared with it."""

    def __init__(self, keys: Keys | None, batch_size: int = BATCH_SIZE) -> None:
        addresses: Queue[str] = _processes.Queue()
        self._figures: Queue[dict[str, float]] = _processes.Queue()
        self.begin, self.stop = _processes.Event(), _processes.Event()
        args = (addresses, self._figures, self.begin, self.stop, keys, batch_size)
        self._process = _processes.Process(target=_serve, args=args, daemon=True)
        self._process.start()
        self.address = addresses.get(timeout=60)

    def rates(self) -> dict[str, float]:
        """Ends the server and returns what it did per second since `begin`."""
        self.stop.set()
        return self._figures.get(timeout=60)

    def cpu_s(self) -> float:
        """Returns the CPU time that the server has used so far."""
        times = psutil.Process(self._process.pid).cpu_times()
        return float(times.user + times.system)

    def __enter__(self) -> ServerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._process.join(10)


def _act(address: str, name: str, keys: Keys | None, stop: Event) -> None:
    """A process: inserts as fast as it is let."""
    chunks = [synthetic_chunk(np.random.default_rng(0))] * CHUNKS_AT_ONCE
    writer = ReplayWriter(address, name, 4 * CHUNKS_AT_ONCE, keys=keys)
    while not stop.is_set():
        if writer.has_room:
            writer.send(chunks, 0)
        writer.poll(0.0 if writer.has_room else 0.1)
    writer.close()


def _learn(address: str, batch_size: int, keys: Keys | None, stop: Event) -> None:
    """A process: takes batches and returns priorities as fast as it can."""
    reader = ReplayReader(address, batch_size, 16, keys=keys)
    while not stop.is_set():
        batch = reader.next(0.1)
        if batch is not None:
            reader.update(batch.items, batch.weights)
    reader.close()


def _saturated(name: str, num_actors: int, batch_size: int, keys: Keys | None) -> list[Record]:
    """Returns the rates of a server that many synthetic actors and a learner load as much as they can."""
    inserted, batches = [], []
    for _ in range(ROUNDS):
        with ServerProcess(keys, batch_size) as server:
            targets = [(_act, (server.address, f"actor{i}", keys, server.stop)) for i in range(num_actors)]
            clients = [_processes.Process(target=target, args=args, daemon=True) for target, args in targets]
            learner = (server.address, batch_size, keys, server.stop)
            clients.append(_processes.Process(target=_learn, args=learner, daemon=True))
            for client in clients:
                client.start()
            time.sleep(WARM_UP_S * (2 + num_actors))  # they import numpy one after the other on few cores
            server.begin.set()
            time.sleep(MEASURED_S)
            rates = server.rates()
            for client in clients:
                client.join(10)
        inserted.append(rates["replay.inserted"])
        batches.append(rates["replay.sampled"] / batch_size)
    insert_mb, batch_mb = message_mb(batch_size)
    moved_mb = [rows * insert_mb + drawn * batch_mb for rows, drawn in zip(inserted, batches, strict=True)]
    return [
        summary(f"{name}.inserted_per_s", "1/s", inserted),
        summary(f"{name}.batches_{batch_size}_per_s", "1/s", batches),
        summary(f"{name}.mb_per_s", "MB/s", moved_mb),
    ]


def message_mb(batch_size: int) -> tuple[float, float]:
    """Returns what an inserted transition and a batch take on the wire, in MB of 1e6 bytes."""
    chunks = [synthetic_chunk(np.random.default_rng(0))] * CHUNKS_AT_ONCE
    store = ReplayStore(_settings(2_000, batch_size), np.random.default_rng(0))
    store.add("actor", 0, chunks)
    batch = store.sample(batch_size, 0)
    insert = encode(Insert("actor", 0, 1, 1, 0, tuple(chunks)), 0)
    num_transitions = sum(len(chunk.starts) for chunk in chunks)
    return len(insert) / num_transitions / 1e6, len(encode(Sample(1, batch), 0)) / 1e6


def _insert_delays(name: str, keys: Keys | None) -> list[Record]:
    """Returns the time from sending 50 transitions to their acknowledgement, with nothing else going on."""
    chunk = synthetic_chunk(np.random.default_rng(0))
    delays_ms = []
    with ServerProcess(keys) as server:
        writer = ReplayWriter(server.address, "actor", 64, keys=keys)
        for _ in range(INSERTS + WARM_UP_INSERTS):
            begun = time.perf_counter()
            writer.send([chunk], 0)
            while not writer.flush(1.0):
                pass
            delays_ms.append((time.perf_counter() - begun) * 1000)
        writer.close()
    return _quantiles(name, delays_ms[WARM_UP_INSERTS:])


def _sample_delays(name: str, keys: Keys | None) -> list[Record]:
    """Returns the time from asking for a batch of 512 to having it decoded, with nothing else going on."""
    delays_ms: list[float] = []
    with ServerProcess(keys) as server:
        writer = ReplayWriter(server.address, "actor", 64, keys=keys)
        for _ in range(100):
            writer.send([synthetic_chunk(np.random.default_rng(0))], 0)
            while not writer.flush(1.0):
                pass
        writer.close()
        reader = ReplayReader(server.address, BATCH_SIZE, 1, keys=keys)
        while len(delays_ms) < INSERTS + WARM_UP_INSERTS:
            begun = time.perf_counter()
            if reader.next(10.0) is not None:
                delays_ms.append((time.perf_counter() - begun) * 1000)
        reader.close()
    return _quantiles(name, delays_ms[WARM_UP_INSERTS:])


def _quantiles(name: str, delays_ms: list[float]) -> list[Record]:
    """Returns the median and the 99th percentile of each of five parts of the delays."""
    parts = [delays_ms[start::5] for start in range(5)]
    return [
        summary(f"{name}.{label}_ms", "ms", [float(np.quantile(part, quantile)) for part in parts])
        for label, quantile in (("p50", 0.5), ("p99", 0.99))
    ]


def _weights_delays(name: str, keys: Keys | None) -> list[Record]:
    """Returns the time from publishing 250,000 parameters until the last of 8 subscribers has them decoded."""
    publisher = WeightsPublisher("tcp://127.0.0.1:0", keys=keys)
    subscribers = [WeightsSubscriber(publisher.address, keys=keys) for _ in range(SUBSCRIBERS)]
    arrays = {"weights": np.random.default_rng(0).random(250_000, dtype=np.float32)}
    delays_ms = []
    for version in range(BROADCASTS + 1):
        begun = time.perf_counter()
        publisher.publish(version, version, arrays)
        waiting = list(subscribers)
        while waiting:
            publisher.serve()
            waiting = [subscriber for subscriber in waiting if subscriber.newest() is None]
        delays_ms.append((time.perf_counter() - begun) * 1000)
    for subscriber in subscribers:
        subscriber.close()
    publisher.close()
    return [summary(name, "ms", delays_ms[1:])]  # the first waited for the connections


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
