"""How much attackers slow the good peers of each listening socket: rates with an attack over rates without.

A server, its good peers and one attacker are processes; the peers do as much as they can. Windows with and without the
attack alternate, and the ratio is of the medians. The attacker is paced, because on few cores its own work would
otherwise be what is measured. Then the peers are ended, and what the attack alone costs the server is measured as its
CPU time: that figure also holds on a machine that has other work.

    python -m benchmarks.hostile docs/results/hostile.json            ten minutes
    python -m benchmarks.hostile docs/results/hostile.json weights    one socket anew
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from itertools import groupby
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zmq

from apex_bat.config.settings import Config, Learner, Replay, Transport
from apex_bat.replay.client import ReplayReader, ReplayWriter
from apex_bat.replay.server import ReplayServer
from apex_bat.transport.messages import Report
from apex_bat.transport.reports import MAX_REPORT_BYTES, ReportCollector, Reporter
from apex_bat.transport.weights import MAX_SUBSCRIPTION_BYTES, WeightsPublisher, WeightsSubscriber
from benchmarks.attacks import CONNECTIONS, ON_REPLAY, ON_REPORTS, ON_WEIGHTS, Shot, Target
from benchmarks.replay import synthetic_chunk

MESSAGES_PER_S, CONNECTIONS_PER_S, OVERSIZED_PER_S = 200, 50, 20
WINDOW_S, PAIRS, PAIRS_ALONE = 0.7, 7, 3
START_S, WARM_UP_S = 60.0, 2.0
GENERATION = 12_345
CHUNKS_AT_ONCE, BATCH_SIZE = 16, 512

_processes = multiprocessing.get_context("spawn")
CPU, ALONE = 2, 3  # places in the shared array: CPU seconds of the server; whether its good peers are gone
Counts = Any  # the shared array, first two counters of good work; multiprocessing gives it no type to name
Record = dict[str, str | float | int]


class Setup(NamedTuple):
    """A listening socket with its good peers."""

    name: str
    serve: Callable[[Any, Counts, Event], None]
    peers: tuple[Callable[[str, Counts, Event], None], ...]
    attacks: dict[str, Callable[[Target], Shot]]
    kind: int
    """Socket type of the attacker."""
    max_message_bytes: int
    counted: tuple[str, ...]
    """What the counters count."""


def serve_replay(addresses: Any, counts: Counts, stop: Event) -> None:
    """A process: the replay server."""
    replay = Replay(capacity=100_000, never_block=True, snapshot_period_s=0.0)
    config = msgspec.structs.replace(
        Config(), replay=replay, learner=Learner(batch_size=BATCH_SIZE), transport=Transport(max_message_mb=2.0)
    )
    server = ReplayServer(config, "tcp://127.0.0.1:0", np.random.default_rng(0), generation=GENERATION)
    addresses.put(server.address)
    while not stop.is_set():
        server.serve(0.05)
        counts[0], counts[1] = server.store.limiter.inserted, server.store.limiter.sampled / BATCH_SIZE
        counts[CPU] = time.process_time()
    server.close()


def insert(address: str, _: Counts, stop: Event) -> None:
    """A process: an actor that inserts as fast as it is let."""
    chunks = [synthetic_chunk(np.random.default_rng(0))] * CHUNKS_AT_ONCE
    writer = ReplayWriter(address, "good", 4 * CHUNKS_AT_ONCE, generation=GENERATION)
    while not stop.is_set():
        if writer.has_room:
            writer.send(chunks, 0)
        writer.poll(0.0 if writer.has_room else 0.1)
    writer.close()


def sample(address: str, _: Counts, stop: Event) -> None:
    """A process: a learner that takes batches and gives priorities as fast as it can."""
    reader = ReplayReader(address, BATCH_SIZE, 16, generation=GENERATION)
    while not stop.is_set():
        batch = reader.next(0.1)
        if batch is not None:
            reader.update(batch.items, batch.weights)
    reader.close()


def serve_weights(addresses: Any, counts: Counts, stop: Event) -> None:
    """A process: a learner that does nothing but broadcast."""
    publisher = WeightsPublisher("tcp://127.0.0.1:0", generation=GENERATION)
    addresses.put(publisher.address)
    arrays = {"a": np.ones(250_000, np.float32)}
    while not stop.is_set():
        if counts[ALONE]:
            time.sleep(0.02)
        else:
            publisher.publish(int(counts[0]), 0, arrays)
            counts[0] += 1
        publisher.serve()
        counts[CPU] = time.process_time()
    publisher.close()


def subscribe(address: str, counts: Counts, stop: Event) -> None:
    """A process: an actor that takes all weights that it can."""
    subscriber = WeightsSubscriber(address, generation=GENERATION)
    while not stop.is_set():
        subscriber.wait(0.1)
        counts[1] += subscriber.newest() is not None
    subscriber.close()


def serve_reports(addresses: Any, counts: Counts, stop: Event) -> None:
    """A process: a launcher that does nothing but collect."""
    collector = ReportCollector("tcp://127.0.0.1:0", generation=GENERATION, roles=["actor-0"])
    addresses.put(collector.address)
    while not stop.is_set():
        counts[0] += len(collector.poll(0.05))
        counts[CPU] = time.process_time()
    collector.close()


def report(address: str, counts: Counts, stop: Event) -> None:
    """A process: a role that reports as fast as it can."""
    reporter = Reporter(address, generation=GENERATION)
    one = Report("actor-0", 1, "host", "", "flying", {f"metric{i}": 1.5 for i in range(30)})
    while not stop.is_set():
        if not reporter.send(one):
            time.sleep(0.0005)
        counts[1] = reporter.dropped
    reporter.close()


SETUPS = (
    Setup("replay", serve_replay, (insert, sample), ON_REPLAY, zmq.DEALER, 2 << 20, ("inserts", "batches")),
    Setup(
        "weights", serve_weights, (subscribe,), ON_WEIGHTS, zmq.DEALER, MAX_SUBSCRIPTION_BYTES,
        ("broadcasts", "received"),
    ),
    Setup("reports", serve_reports, (report,), ON_REPORTS, zmq.PUSH, MAX_REPORT_BYTES, ("reports",)),
)  # fmt: skip


def rate_of(attack: str) -> int:
    """Returns how many shots a second an attack makes."""
    return OVERSIZED_PER_S if attack == "oversized" else CONNECTIONS_PER_S if attack in CONNECTIONS else MESSAGES_PER_S


def attack(number: int, address: str, name: str, go: Event, stop: Event) -> None:
    """A process: one attack on a setup, named by its number, at its rate while it is told to go on."""
    setup = SETUPS[number]
    target = Target(address, GENERATION, setup.max_message_bytes, setup.kind)
    shoot, period_s = setup.attacks[name](target), 1.0 / rate_of(name)
    due_s = time.monotonic()
    while not stop.is_set():
        if not go.wait(0.05):
            due_s = time.monotonic()
            continue
        shoot()
        due_s = max(due_s + period_s, time.monotonic() - 0.1)
        time.sleep(max(0.0, due_s - time.monotonic()))


def measure(setup: Setup) -> list[Record]:
    """Returns a record for each attack on a socket and each rate of its good peers."""
    counts, addresses = _processes.Array("d", 4, lock=False), _processes.Queue()
    stop, leave = _processes.Event(), _processes.Event()
    server = _start(setup.serve, addresses, counts, stop)
    address = addresses.get(timeout=START_S)
    peers = [_start(peer, address, counts, leave) for peer in setup.peers]
    while not all(counts[: len(setup.counted)]):
        time.sleep(0.1)
    time.sleep(WARM_UP_S)
    rates = {name: _under(setup, name, address, counts, PAIRS) for name in setup.attacks}
    leave.set()
    for peer in peers:
        peer.join(10)
    counts[ALONE] = 1.0
    alone = {name: _under(setup, name, address, counts, PAIRS_ALONE) for name in setup.attacks}
    stop.set()
    server.join(10)
    return [
        _record(setup.name, name, counted, [[window[i] for window in rates[name][on]] for on in (0, 1)], alone[name])
        for name in setup.attacks
        for i, counted in enumerate(setup.counted)
    ]


Windows = list[list[list[float]]]  # without and with the attack: windows of rates a second


def _under(setup: Setup, name: str, address: str, counts: Counts, num_pairs: int) -> Windows:
    go, over = _processes.Event(), _processes.Event()
    attacker = _start(attack, SETUPS.index(setup), address, name, go, over)
    time.sleep(WARM_UP_S)
    rates: Windows = [[], []]
    for _ in range(num_pairs):
        for is_attacked in (False, True):
            (go.set if is_attacked else go.clear)()
            before, begun_s = list(counts), time.perf_counter()
            time.sleep(WINDOW_S)
            elapsed_s = time.perf_counter() - begun_s
            rates[is_attacked].append([(now - then) / elapsed_s for now, then in zip(counts, before, strict=True)])
    over.set()
    attacker.join(10)
    return rates


def _record(socket_name: str, attack_name: str, counted: str, rates: list[list[float]], alone: Windows) -> Record:
    without, under = (float(np.median(each)) for each in rates)
    idle, busy = (float(np.mean([window[CPU] for window in windows])) for windows in alone)
    return {
        "socket": socket_name, "attack": attack_name, "shots_per_s": rate_of(attack_name), "counted": counted,
        "without_per_s": without, "with_per_s": under, "ratio": under / without, "pairs": PAIRS,
        "cpu_share": max(0.0, busy - idle),
    }  # fmt: skip


def _start(target: Callable[..., None], *args: Any) -> multiprocessing.process.BaseProcess:
    process = _processes.Process(target=target, args=args, daemon=True)
    process.start()
    return process


def table(records: Sequence[Record]) -> str:
    """Returns the table of docs/security.md: a row for each attack, with the ratio of each thing that was counted."""
    lines = ["| socket | attack | shots/s | server's CPU [%] | rate with / without |", "|---|---|--:|--:|---|"]
    for (name, attacked), group in groupby(records, lambda record: (record["socket"], record["attack"])):
        found = list(group)
        ratios = ", ".join(f"{record['counted']} {record['ratio']:.2f}" for record in found)
        share = 100 * float(found[0]["cpu_share"])
        lines.append(f"| {name} | {attacked} | {found[0]['shots_per_s']} | {share:.1f} | {ratios} |")
    return "\n".join(lines)


def main(path: Path, only: Sequence[str]) -> None:
    """Measures all sockets, or some of them anew, writes the records and prints their table."""
    former: list[Record] = json.loads(path.read_text(encoding="utf-8")) if only else []
    records: list[Record] = []
    for setup in SETUPS:
        kept = [record for record in former if record["socket"] == setup.name]
        records += measure(setup) if setup.name in only or not only else kept
    path.write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
    print(table(records))


if __name__ == "__main__":
    given, names = sys.argv[1:2], sys.argv[2:]
    if not given or set(names) - {setup.name for setup in SETUPS}:
        sys.exit(f"{(__doc__ or '').strip()}\n\nsockets: {', '.join(setup.name for setup in SETUPS)}")
    main(Path(given[0]), names)
