"""The replay server: one socket, one thread, a plain poll loop around `ReplayStore`.

Inserts wait in one queue an actor, sample requests in one a learner; after each look at the socket the server stores
and answers, in turn, all that the rate limiter allows. A plain loop, because asyncio costs 2.9 times its CPU
(measured). `intake` is the actors' side of it, `outlet` the learner's; `saving` writes the snapshots.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from apex_bat.config.settings import Config
from apex_bat.replay.arrivals import Arrival
from apex_bat.replay.heap import keep_freed_memory
from apex_bat.replay.intake import Intake
from apex_bat.replay.outlet import Outlet
from apex_bat.replay.saving import Snapshots
from apex_bat.replay.snapshot import SnapshotError
from apex_bat.replay.store import ReplayStore
from apex_bat.transport.messages import (
    Insert,
    InsertHeader,
    Message,
    MessageError,
    PartRequest,
    PriorityUpdate,
    Ratio,
    RatioChange,
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
NOTICE_PERIOD_S = 0.5  # how often the held-back are told why; clients send again only when they hear nothing
LIVES = 1 << 20  # of a server, whose items have numbers of their own
ITEMS_OF_A_LIFE = 1 << 36  # numbers; with those of all lives and of 64 servers they are less than 2^63
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
        life: another number for each start of the server in a run.
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
        life: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        keep_freed_memory()
        self.store = ReplayStore(config, generator)
        self.store.first_number = life % LIVES * ITEMS_OF_A_LIFE
        self._refusals = Refusals(logger, clock)
        self._intake = Intake(config, self.store, self._refusals, self._send)
        self._outlet = Outlet(config, self.store, self._refusals, self._send)
        self._snapshots = Snapshots(self.store.buffer, snapshot_path, config.replay.snapshot_period_s, clock)
        self._generation = generation
        self._clock = clock
        self._undelivered = 0
        self._phases_s = dict.fromkeys(("idle", "receive", "insert", "sample", "update"), 0.0)
        self._has_work = False
        self._next_notice_s = clock()
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
        self._has_work = self._repeat("sample", self._outlet.answer_next) | self._repeat(
            "insert", self._intake.store_next
        )
        if self._clock() >= self._next_notice_s:
            self._notify()
        self._snapshots.tend(self._state)

    def state(self) -> str:
        """Returns what the server does, or who waits for whom."""
        return self.store.limiter.waiting_reason() or "serving"

    def metrics(self) -> dict[str, float]:
        """Returns all figures that `replay.metrics.METRICS` describes."""
        figures = self.store.metrics() | {f"replay.{name}": float(count) for name, count in self._counts().items()}
        figures["replay.refused_messages"] = self._refusals.total
        refused = self.refusals
        figures |= {f"replay.refused_messages.{reason}": float(refused.get(reason, 0)) for reason in REASONS}
        figures["replay.ended_connections"] = self._listener.num_ended
        figures["replay.queued_inserts"] = len(self._intake)
        figures["replay.queued_requests"] = len(self._outlet.requests)
        figures |= {f"replay.{phase}_s": seconds for phase, seconds in self._phases_s.items()}
        return figures

    @property
    def refusals(self) -> dict[str, int]:
        """Refused messages so far, by reason."""
        return self._refusals.counts.copy()

    def save(self) -> None:
        """Writes a snapshot and waits for it. Raises OSError if that fails, ValueError without a path."""
        self._snapshots.save(self._state)

    def restore(self) -> str:
        """Takes over the newest sound snapshot and returns what was restored, as one line.

        Raises:
            FileNotFoundError: there is none.
            SnapshotError: none is sound, or it does not fit the settings.
        """
        state, path = self._snapshots.read()
        try:
            self.store.restore(state)
            counts = state["counts"]
            self._intake.restore(state["sequences"], counts)
            self._snapshots.counts |= {name: int(counts[name]) for name in self._snapshots.counts}
            self._undelivered = int(counts["undelivered"])
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise SnapshotError(f"{path}: its state contradicts itself: {error!r}") from error
        counters = self.store.buffer.counters
        return f"replay: {len(self.store.buffer)} transitions, {counters.next_item} ever inserted, from {path}"

    def close(self) -> None:
        """Closes the socket; a snapshot in the making is given up. May be called twice."""
        self._snapshots.drop()
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
                self._intake.arrive(peer, Arrival(message, "", num_bytes))
            case SampleRequest() | PartRequest():
                self._outlet.arrive(peer, message)
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
                self._snapshots.hasten()  # so that a crash does not bring the old law back
            except ValueError as error:
                refused = str(error)
        return Ratio(*limiter.law, refused)

    def _refuse(self, peer: bytes, error: MessageError, num_bytes: int) -> None:
        """Counts a bad message. A bad insert with a readable header is refused in its turn: its actor can go on."""
        if isinstance(error.head, InsertHeader):
            self._refusals.count(error.fault, f"{error.head.actor}: {error}")
            self._intake.arrive(peer, Arrival(error.head, str(error), num_bytes))
        else:
            self._refusals.count(error.fault, str(error))

    def _repeat(self, phase: str, step: Callable[[], bool]) -> bool:
        """Repeats a step while it finds work, for WORK_S at most; returns whether it found any."""
        begun = time.perf_counter()
        found = False
        while step():
            found = True
            if time.perf_counter() >= begun + WORK_S:
                break
        self._spend(phase, begun)
        return found

    def _notify(self) -> None:
        """Tells everybody who is held back that the server lives, and for whom it waits."""
        self._next_notice_s = self._clock() + NOTICE_PERIOD_S
        for peer in self._outlet.requests.peers() | self._intake.waiting_peers():
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
            self._undelivered += 1
            return False
        return True

    def _state(self) -> dict[str, Any]:
        return self.store.state() | {"sequences": self._intake.stored_sequences(), "counts": self._counts()}

    def _counts(self) -> dict[str, int]:
        return {**self._intake.counts, "undelivered": self._undelivered, **self._snapshots.counts}

    def _spend(self, phase: str, begun: float) -> None:
        self._phases_s[phase] += time.perf_counter() - begun
