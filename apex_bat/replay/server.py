"""The replay server: one socket, one thread, a plain poll loop around `ReplayStore`.

Inserts wait in one queue an actor, sample requests in one queue; after each look at the socket the server stores and
answers, in turn, all that the rate limiter allows. An insert is acknowledged when it is stored, so an actor whose
window of unacknowledged inserts is full waits: that is how a slow learner slows the actors. A plain loop, because
asyncio costs 2.9 times its CPU (measured).
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from apex_bat.config.settings import Config
from apex_bat.replay.arrivals import Arrival, Arrivals, StoredSequence
from apex_bat.replay.heap import keep_freed_memory
from apex_bat.replay.requests import SampleRequests
from apex_bat.replay.snapshot import SnapshotError, SnapshotWriter, read_snapshot
from apex_bat.replay.store import RefusedChunkError, ReplayStore
from apex_bat.transport.messages import (
    Ack,
    Insert,
    InsertHeader,
    Message,
    MessageError,
    PriorityUpdate,
    Ratio,
    RatioChange,
    Sample,
    SampleRequest,
    Waiting,
    decode,
    encode,
)
from apex_bat.transport.refusals import REASONS, Refusals
from apex_bat.transport.security import Keys
from apex_bat.transport.sockets import Listener

logger = logging.getLogger(__name__)

RECEIVE_AT_ONCE = 64  # messages taken from the socket before those that wait are looked at
WORK_S = 0.003  # time each for requests and for inserts that wait, before the socket is looked at again
MAX_QUEUED_MESSAGES = 8  # of the largest size that may be sent: as many bytes of inserts may wait, whoever sent them
NOTICE_PERIOD_S = 0.5  # how often the held-back are told why; clients send again only when they hear nothing
COPY_BELOW_BYTES = 65_536  # ZeroMQ sends larger messages without copying them


class ReplayServer:
    """Serves a `ReplayStore` at an address.

    Args:
        config: the settings.
        address: where to listen; port 0 takes any free one.
        generator: draws the samples.
        snapshot_path: file of the snapshots; None: none are made.
        keys: CURVE keys, for an address that is not loopback.
        generation: of this address; messages of another are refused.
        clock: seconds, monotonic.

    Attributes:
        address: where it listens.
        store: the replay itself.

    Raises:
        TransportError: the address cannot be used.
        ValueError: the rate limiter's settings could lead to a standstill.
    """

    def __init__(
        self,
        config: Config,
        address: str,
        generator: np.random.Generator,
        snapshot_path: Path | None = None,
        *,
        keys: Keys | None = None,
        generation: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        keep_freed_memory()
        self.store = ReplayStore(config, generator)
        self._arrivals = Arrivals(config.actor.window_chunks, MAX_QUEUED_MESSAGES * config.transport.max_message_bytes)
        self._requests = SampleRequests()
        self._batch_size = config.learner.batch_size
        self._snapshot_path = snapshot_path
        self._snapshot_period_s = config.replay.snapshot_period_s or math.inf
        self._snapshot: SnapshotWriter | None = None
        self._generation = generation
        self._clock = clock
        self._refusals = Refusals(logger, clock)
        self._counts = dict.fromkeys(_COUNTS, 0)
        self._phases_s = dict.fromkeys(("idle", "receive", "insert", "sample", "update"), 0.0)
        self._has_work = False
        self._next_notice_s = clock()
        self._next_snapshot_s = clock() + self._snapshot_period_s
        self._listener = Listener(
            zmq.ROUTER,
            address,
            self._refusals,
            keys=keys,
            max_message_bytes=config.transport.max_message_bytes,
            options={zmq.ROUTER_MANDATORY: 1},
        )
        self.address = self._listener.address

    def serve(self, timeout_s: float) -> None:
        """Waits up to `timeout_s` for a message, handles what is there, stores and answers for some milliseconds."""
        begun = time.perf_counter()
        ready = self._listener.socket.poll(0 if self._has_work else int(timeout_s * 1000))
        self._spend("idle", begun)
        if ready:
            self._receive()
        # The same time for learner and actors, if both want all of it: neither can crowd out the other.
        self._has_work = self._repeat(self._answer_next) | self._repeat(self._store_next)
        if self._clock() >= self._next_notice_s:
            self._notify()
        if self._snapshot_path is not None:
            self._snapshot_in_background(self._snapshot_path)

    def state(self) -> str:
        """Returns what the server does, or who waits for whom."""
        return self.store.limiter.waiting_reason() or "serving"

    def metrics(self) -> dict[str, float]:
        """Returns all figures that `replay.metrics.METRICS` describes."""
        figures = self.store.metrics() | {f"replay.{name}": float(count) for name, count in self._counts.items()}
        figures["replay.refused_messages"] = self._refusals.total
        refused = self.refusals
        figures |= {f"replay.refused_messages.{reason}": float(refused.get(reason, 0)) for reason in REASONS}
        figures["replay.ended_connections"] = self._listener.num_ended
        figures["replay.queued_inserts"] = len(self._arrivals)
        figures["replay.queued_requests"] = len(self._requests)
        figures |= {f"replay.{phase}_s": seconds for phase, seconds in self._phases_s.items()}
        return figures

    @property
    def refusals(self) -> dict[str, int]:
        """Refused messages so far, by reason."""
        return self._refusals.counts.copy()

    def save(self) -> None:
        """Writes a snapshot and waits for it. Raises OSError if that fails, ValueError without a path."""
        if self._snapshot_path is None:
            raise ValueError("this server has no snapshot_path")
        self._drop_snapshot()
        SnapshotWriter(self.store.buffer, self._snapshot_path).advance(self._state, wait=True)

    def restore(self) -> str:
        """Takes over the newest sound snapshot and returns what was restored, as one line.

        Raises:
            FileNotFoundError: there is none.
            SnapshotError: none is sound, or it does not fit the settings.
        """
        if self._snapshot_path is None:
            raise FileNotFoundError("this server has no snapshot_path")
        state, path = read_snapshot(self._snapshot_path, self.store.buffer)
        try:
            self.store.restore(state)
            self._arrivals.restore(
                {actor: StoredSequence(s[0], s[1], tuple(s[2])) for actor, s in state["sequences"].items()}
            )
            self._counts |= {name: int(state["counts"][name]) for name in _COUNTS}
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise SnapshotError(f"{path}: its state contradicts itself: {error!r}") from error
        counters = self.store.buffer.counters
        return f"replay: {len(self.store.buffer)} transitions, {counters.next_item} ever inserted, from {path}"

    def close(self) -> None:
        """Closes the socket; a snapshot in the making is given up. May be called twice."""
        self._drop_snapshot()
        self._listener.close()

    def _receive(self) -> None:
        for _ in range(RECEIVE_AT_ONCE):
            begun = time.perf_counter()
            try:
                parts = self._listener.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            try:
                if len(parts) != 2:
                    raise MessageError("parts", f"{len(parts) - 1} instead of one")
                message = decode(parts[1], self._generation)
            except MessageError as error:
                self._refuse(parts[0], error, len(parts[-1]))
            else:
                self._spend("receive", begun)
                self._handle(parts[0], message, len(parts[1]))

    def _handle(self, peer: bytes, message: Message, num_bytes: int) -> None:
        match message:
            case Insert():
                self._arrive(peer, Arrival(message, "", num_bytes))
            case SampleRequest():
                self._queue_request(peer, message)
            case PriorityUpdate(learner_step, items, priorities):
                begun = time.perf_counter()
                self.store.update(learner_step, items, priorities)
                self._spend("update", begun)
            case RatioChange():
                self._send(peer, self._changed(message))
            case _:
                self._refusals.count("unexpected", f"a replay server takes no {type(message).__name__}")

    def _changed(self, change: RatioChange) -> Ratio:
        """Changes the law of the rate limiter, or says why not."""
        limiter, refused = self.store.limiter, ""
        if limiter.never_block:
            refused = "replay.never_block is set: nobody waits, and the ratio is what the machine gives"
        else:
            try:
                limiter.change(change.samples_per_insert, change.error_buffer)
                logger.warning("samples per insert is now %g, within %g samples", *limiter.law)
                self._next_snapshot_s = self._clock()  # so that a crash does not bring the old law back
            except ValueError as error:
                refused = str(error)
        return Ratio(*limiter.law, refused)

    def _arrive(self, peer: bytes, arrival: Arrival) -> None:
        header = arrival.header
        verdict = self._arrivals.offer(arrival, peer)
        if verdict in ("stored", "held"):
            self._counts["duplicates"] += 1
        elif verdict in ("gap", "flood"):
            self._counts["out_of_turn"] += 1
        if verdict == "stored":
            self._send(peer, Ack(header.incarnation, header.sequence))
        elif verdict == "superseded":
            self._refusals.count("superseded", f"{header.actor}: another incarnation has taken its place")
            self._send(peer, Ack(header.incarnation, header.sequence, superseded=True))

    def _queue_request(self, peer: bytes, request: SampleRequest) -> None:
        if request.batch_size != self._batch_size:
            self._refusals.count("batch_size", f"{request.batch_size}; learner.batch_size is {self._batch_size}")
            return
        # Noted on arrival: when the request's turn comes, a later update may have told a later step.
        self.store.learner_step = request.learner_step
        if self._requests.offer(peer, request) == "flood":
            self._refusals.count("flood", f"{len(self._requests)} sample requests wait already")

    def _refuse(self, peer: bytes, error: MessageError, num_bytes: int) -> None:
        """Counts a bad message. A bad insert with a readable header is refused in its turn: its actor can go on."""
        if isinstance(error.head, InsertHeader):
            self._refusals.count(error.fault, f"{error.head.actor}: {error}")
            self._arrive(peer, Arrival(error.head, str(error), num_bytes))
        else:
            self._refusals.count(error.fault, str(error))

    def _repeat(self, step: Callable[[], bool]) -> bool:
        """Repeats a step while it finds work, for WORK_S at most; returns whether it found any."""
        ends_s = time.perf_counter() + WORK_S
        found = False
        while step():
            found = True
            if time.perf_counter() >= ends_s:
                break
        return found

    def _store_next(self) -> bool:
        """Stores or refuses the insert whose turn it is; returns whether there was one that need not wait."""
        arrival = self._arrivals.peek()
        if arrival is None:
            return False
        begun = time.perf_counter()
        header, reason, _ = arrival
        num_transitions = _num_transitions(header)
        if isinstance(header, Insert) and not reason:
            reason = self.store.limiter.refusal(num_transitions)
            if reason:
                self._refusals.count("chunk", f"{header.actor}: {reason}")
        if isinstance(header, Insert) and not reason:
            if not self.store.can_add(num_transitions):
                return False
            try:
                self.store.add(header.actor, header.learner_step, header.chunks)
            except RefusedChunkError as error:
                reason = str(error)
                self._refusals.count("chunk", reason)
        if reason:
            self._counts["refused"] += num_transitions
        self._counts["received"] += num_transitions
        peer = self._arrivals.settle()
        if peer is not None:
            self._send(peer, Ack(header.incarnation, header.sequence, reason[:500]))
        self._spend("insert", begun)
        return True

    def _answer_next(self) -> bool:
        """Answers the oldest sample request; returns whether there was one that need not wait."""
        request = self._requests.peek()
        if request is None or not self.store.can_sample(request.batch_size):
            return False
        begun = time.perf_counter()
        peer, _ = self._requests.take()
        batch = self.store.sample(request.batch_size, self.store.learner_step)
        if self._send(peer, Sample(request.request, batch)):
            self.store.count_sample(request.batch_size)
        self._spend("sample", begun)
        return True

    def _notify(self) -> None:
        """Tells everybody who is held back that the server lives, and for whom it waits."""
        self._next_notice_s = self._clock() + NOTICE_PERIOD_S
        for peer in self._requests.peers() | set(self._arrivals.waiting_peers()):
            self._send(peer, Waiting(self.state()))

    def _send(self, peer: bytes, message: Message) -> bool:
        """Sends to a peer; returns False, counted, if it is gone or takes nothing more. It will ask again."""
        data = encode(message, self._generation)
        try:
            self._listener.socket.send(peer, zmq.SNDMORE | zmq.NOBLOCK)
            self._listener.socket.send(data, zmq.NOBLOCK, copy=len(data) < COPY_BELOW_BYTES)
        except zmq.ZMQError as error:
            if error.errno not in (zmq.EAGAIN, zmq.EHOSTUNREACH):
                raise
            self._counts["undelivered"] += 1
            return False
        return True

    def _state(self) -> dict[str, Any]:
        return self.store.state() | {"sequences": self._arrivals.stored_sequences(), "counts": self._counts.copy()}

    def _snapshot_in_background(self, path: Path) -> None:
        if self._snapshot is None:
            if self._clock() >= self._next_snapshot_s:
                self._snapshot = SnapshotWriter(self.store.buffer, path)
            return
        try:
            if not self._snapshot.advance(self._state):
                return
            self._counts["snapshots"] += 1
        except OSError as error:
            self._counts["failed_snapshots"] += 1
            logger.error("the snapshot of the replay failed, the one before is kept: %s", error)
        self._snapshot = None
        self._next_snapshot_s = self._clock() + self._snapshot_period_s

    def _drop_snapshot(self) -> None:
        if self._snapshot is not None:
            self._snapshot.abandon()
            self._snapshot = None

    def _spend(self, phase: str, begun: float) -> None:
        self._phases_s[phase] += time.perf_counter() - begun


_COUNTS = ("received", "refused", "duplicates", "out_of_turn", "undelivered", "snapshots", "failed_snapshots")


def _num_transitions(header: Insert | InsertHeader) -> int:
    if isinstance(header, InsertHeader):
        return sum(header.transitions)
    return sum(len(chunk.starts) for chunk in header.chunks)
