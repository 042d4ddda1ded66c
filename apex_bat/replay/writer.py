"""The actor's end of the replay: sends chunks, keeps them until they are acknowledged, sends them again if need be."""

from __future__ import annotations

import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence

import zmq

from apex_bat.experience import Chunk
from apex_bat.transport.messages import Ack, Insert, MessageError, Waiting, decode, encode
from apex_bat.transport.security import Keys, TransportError
from apex_bat.transport.sockets import MAX_MESSAGE_BYTES, Connection

RESEND_S = 2.0  # silence after which all that is unacknowledged goes again; a living server speaks each half second


class ReplayWriter:
    """Sends the chunks of one actor to its replay server.

    Args:
        address: of the server.
        actor: name, the same after a restart.
        window_chunks: chunks that may be unacknowledged.
        keys: CURVE keys, for an address that is not loopback.
        generation: of the address.
        incarnation: number of this life of the actor; None: a random one.
        resend_s: silence after which everything unacknowledged is sent again.
        max_message_bytes: of a message from the server.
        clock: seconds, monotonic.

    Attributes:
        waiting: for whom the server waits, as it said last; empty when it stores at once.
        sent, acknowledged, refused, resent: transitions so far; the last one counts inserts.
    """

    def __init__(
        self,
        address: str,
        actor: str,
        window_chunks: int,
        *,
        keys: Keys | None = None,
        generation: int = 0,
        incarnation: int | None = None,
        resend_s: float = RESEND_S,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._actor = actor
        self._window_chunks = window_chunks
        self._generation = generation
        self._incarnation = secrets.randbits(62) if incarnation is None else incarnation
        self._resend_s = resend_s
        self._clock = clock
        self._window: OrderedDict[int, Insert] = OrderedDict()
        self._chunks_out = 0
        self._next_sequence = 1
        self._next_to_send = 1
        self._patience_ends_s = clock() + resend_s
        self.waiting = ""
        self.sent = 0
        self.acknowledged = 0
        self.refused = 0
        self.resent = 0
        self.refused_messages = 0
        # IMMEDIATE: without a connection nothing is queued, so the window is all that an actor has under way.
        options: dict[int, int] = {zmq.IMMEDIATE: 1}
        self._connection = Connection(
            zmq.DEALER, address, keys=keys, max_message_bytes=max_message_bytes, options=options
        )

    def redirect(self, address: str, generation: int) -> None:
        """Goes to the server at another address, with all that is unacknowledged.

        Raises:
            TransportError: the address cannot be used.
        """
        self._connection.redirect(address)
        if generation != self._generation:
            self._generation = generation
            self._next_to_send = next(iter(self._window), self._next_sequence)
            self.waiting = ""

    @property
    def has_room(self) -> bool:
        """Whether `send` may be called; otherwise call `poll` until it may."""
        return self._chunks_out < self._window_chunks

    @property
    def unacknowledged(self) -> int:
        """Inserts that the server has not answered for."""
        return len(self._window)

    @property
    def socket(self) -> zmq.Socket[bytes]:
        """What answers come by, to be waited for together with others."""
        return self._connection.socket

    def send(self, chunks: Sequence[Chunk], learner_step: int) -> None:
        """Sends chunks as one insert. Their arrays must not change afterwards: they may have to go again.

        Args:
            chunks: one or more; one of each bat that has one, say.
            learner_step: updates that the actor's weights had seen.

        Raises:
            ValueError: the window is full, or there are no chunks.
        """
        if not self.has_room or not chunks:
            raise ValueError("the window is full: poll until has_room" if chunks else "an insert needs a chunk")
        if not self._window:
            self._patience_ends_s = self._clock() + self._resend_s
        insert = Insert(self._actor, self._incarnation, self._next_sequence, 0, learner_step, tuple(chunks))
        self._window[insert.sequence] = insert
        self._next_sequence += 1
        self._chunks_out += len(chunks)
        self.sent += _num_transitions(insert)
        self._push()

    def poll(self, timeout_s: float) -> None:
        """Handles answers, waiting up to `timeout_s` for one if something is unacknowledged, and sends what is due.

        Raises:
            TransportError: the server refused our keys, or another actor of this name has taken our place.
        """
        self._connection.check()
        self._push()
        if self._window and self._connection.socket.poll(int(timeout_s * 1000)):
            self._receive()
        if self._window and self._clock() >= self._patience_ends_s:
            self.waiting = ""  # what a silent server said last is no longer why nothing comes
            self.resent += self._next_to_send - next(iter(self._window))
            self._next_to_send = next(iter(self._window))
            self._patience_ends_s = self._clock() + self._resend_s
            self._push()

    def flush(self, timeout_s: float) -> bool:
        """Waits until all is acknowledged, up to `timeout_s`; returns whether it is."""
        ends_s = time.monotonic() + timeout_s
        while self._window and (left_s := ends_s - time.monotonic()) > 0:
            self.poll(min(left_s, 0.1))
        return not self._window

    def counters(self) -> dict[str, float]:
        """Returns the figures that `replay.metrics.WRITER_METRICS` describes."""
        return {
            "writer.sent": self.sent,
            "writer.acknowledged": self.acknowledged,
            "writer.refused": self.refused,
            "writer.resent": self.resent,
            "writer.unacknowledged": len(self._window),
            "writer.refused_messages": self.refused_messages,
        }

    def close(self) -> None:
        """Closes the socket; what is unacknowledged may be lost. May be called twice."""
        self._connection.close()

    def _push(self) -> None:
        """Sends, in order, what has not been sent yet, as far as the socket takes it."""
        while self._next_to_send < self._next_sequence:
            first = next(iter(self._window))
            message = self._window[self._next_to_send]._replace(first_unacknowledged=first)
            try:
                self._connection.socket.send(encode(message, self._generation), zmq.NOBLOCK)
            except zmq.Again:
                return
            self._next_to_send += 1

    def _receive(self) -> None:
        while self._connection.socket.poll(0):
            try:
                message = decode(self._connection.socket.recv(zmq.NOBLOCK), self._generation)
            except MessageError:
                self.refused_messages += 1
                continue
            if isinstance(message, Waiting):
                self.waiting = message.reason
            elif isinstance(message, Ack) and message.incarnation == self._incarnation:
                self._settle(message)
            self._patience_ends_s = self._clock() + self._resend_s

    def _settle(self, ack: Ack) -> None:
        """Forgets what is acknowledged. The server works in order: an answer settles all before it."""
        if ack.superseded:
            raise TransportError(f"{self._actor}: another actor of this name has taken its place")
        self.waiting = ""
        while self._window and next(iter(self._window)) <= ack.sequence:
            sequence, insert = self._window.popitem(last=False)
            self._chunks_out -= len(insert.chunks)
            self._next_to_send = max(self._next_to_send, sequence + 1)
            if ack.refused and sequence == ack.sequence:
                self.refused += _num_transitions(insert)
            else:
                self.acknowledged += _num_transitions(insert)


def _num_transitions(insert: Insert) -> int:
    return sum(len(chunk.starts) for chunk in insert.chunks)
