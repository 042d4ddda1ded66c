"""Broadcast of the network's weights: newest wins, and who subscribes late gets the newest at once.

One message is one part, because the subscribers conflate: of all that has arrived they keep the last message only.
The age of what a subscriber finds was 2.3 ms so, against 4.5 s with a queue of 1,000 (medians, measured). A plain PUB
sends nothing to late subscribers; an XPUB sees each subscription come, and the newest weights are sent once more.
They are also sent again after a silence: a queue that is full (a subscriber stopped, a cable out) drops what is new.

A publisher listens too. Subscribers may send nothing but the subscription to everything; libzmq keeps all others that a
stranger makes up, so the socket is opened anew before they fill the memory.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

import numpy as np
import zmq
from numpy.typing import NDArray

from apex_bat.transport.messages import MessageError, Weights, decode, encode
from apex_bat.transport.refusals import Refusals
from apex_bat.transport.security import Keys
from apex_bat.transport.sockets import MAX_MESSAGE_BYTES, Connection, Listener

logger = logging.getLogger(__name__)

HIGH_WATER = 4  # broadcasts queued for one slow subscriber; older ones are of no use
REPEAT_S = 2.0  # silence after which the newest weights are sent again
LEAST_REPEAT_S = 0.1  # between two broadcasts for late subscribers: who subscribes all the time must not load the rest
AT_ONCE = 100  # notices looked at by one call
MAX_NOTICE_BYTES = 1024  # of what a subscriber sends: handshakes have 200 to 400, a subscription 1
HEARTBEAT_MS = 1000
HEARTBEAT_TIMEOUT_MS = 3000  # silence after which a subscriber counts as gone
MAX_STRANGE = 256  # subscriptions to something else until the socket is opened anew; each may hold 1 KB, 40 in libzmq


class WeightsPublisher:
    """The learner's end.

    Args:
        address: where to listen; port 0 takes any free one.
        keys: CURVE keys, for an address that is not loopback.
        generation: of this address, repeated in each message.
        clock: seconds, monotonic.

    Attributes:
        address: where it listens.
        refusals: counts of refused connections, subscriptions and messages by reason.

    Raises:
        TransportError: the address cannot be used.
    """

    def __init__(
        self,
        address: str,
        *,
        keys: Keys | None = None,
        generation: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.refusals = Refusals(logger, clock)
        self._keys = keys
        self._generation = generation
        self._clock = clock
        self._newest: bytearray | None = None
        self._sent_s = clock()
        self._repeated_s = float("-inf")
        self._is_wanted = False
        self._num_strange = 0
        self._listener = self._open(address)
        self.address = self._listener.address

    def publish(self, version: int, learner_step: int, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        """Broadcasts weights; they are copied.

        Args:
            version: grows with each broadcast.
            learner_step: updates that these weights have seen.
            arrays: float32 arrays by name.
        """
        contiguous = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}
        self._newest = encode(Weights(version, learner_step, contiguous), self._generation)
        self._send()

    def serve(self) -> None:
        """Sends the newest weights again if somebody has subscribed, or after a silence. Call it often.

        Raises:
            TransportError: the socket had to be opened anew, and could not.
        """
        for _ in range(AT_ONCE):
            if not self._listener.socket.poll(0):
                break
            self._take(self._listener.socket.recv_multipart(zmq.NOBLOCK))
        if self._num_strange > MAX_STRANGE:
            self._reopen()
        now_s = self._clock()
        if now_s - self._sent_s >= REPEAT_S or (self._is_wanted and now_s - self._repeated_s >= LEAST_REPEAT_S):
            self._repeated_s = now_s
            self._is_wanted = False
            self._send()

    def close(self) -> None:
        """Closes the socket; may be called twice."""
        self._listener.close()

    def _open(self, address: str) -> Listener:
        options: dict[int, int] = {
            zmq.XPUB_VERBOSE: 1,  # every subscription is told, not only the first
            # Without them strangers that stay half-way could hold this socket in libzmq for 30 s (seen). A subscriber's
            # queue is of one message and never full, so that libzmq's fault, told in `sockets`, cannot meet it.
            zmq.HEARTBEAT_IVL: HEARTBEAT_MS,
            zmq.HEARTBEAT_TIMEOUT: HEARTBEAT_TIMEOUT_MS,
        }
        return Listener(
            zmq.XPUB,
            address,
            self.refusals,
            keys=self._keys,
            max_message_bytes=MAX_NOTICE_BYTES,
            high_water=HIGH_WATER,
            options=options,
        )

    def _reopen(self) -> None:
        """Forgets all subscriptions. Subscribers connect again by themselves, and say again what they want."""
        self._listener.close()
        self._listener = self._open(self.address)
        self._num_strange = 0

    def _take(self, parts: list[bytes]) -> None:
        """Looks at a notice: 1 and the topic for a subscription, 0 and the topic for its end."""
        if parts == [b"\x01"]:
            self._is_wanted = True
        elif len(parts) == 1 and parts[0][:1] == b"\x01":
            self._num_strange += 1
            self.refusals.count("subscription", f"to {len(parts[0]) - 1} bytes")
        elif len(parts) != 1 or parts[0][:1] != b"\x00":
            self.refusals.count("unexpected", f"a message of {len(parts)} parts to a publisher")

    def _send(self) -> None:
        if self._newest is not None:
            self._listener.socket.send(self._newest, zmq.NOBLOCK, copy=False)
        self._sent_s = self._clock()


class WeightsSubscriber:
    """An actor's or evaluator's end.

    Args:
        address: of the publisher.
        expected: shape of each array by name, which weights must match exactly; None: anything goes.
        keys: CURVE keys, for an address that is not loopback.
        generation: of the address; weights of another are refused.
        max_message_bytes: a larger message is refused.

    Attributes:
        refusals: counts of refused weights by reason.
    """

    def __init__(
        self,
        address: str,
        expected: Mapping[str, tuple[int, ...]] | None = None,
        *,
        keys: Keys | None = None,
        generation: int = 0,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
    ) -> None:
        options: dict[int, int] = {zmq.CONFLATE: 1}
        self._connection = Connection(zmq.SUB, address, keys=keys, max_message_bytes=max_message_bytes, options=options)
        self._connection.socket.setsockopt(zmq.SUBSCRIBE, b"")
        self._expected = None if expected is None else dict(expected)
        self._generation = generation
        self._last: tuple[int, int] | None = None
        self.refusals = Refusals(logger)

    def newest(self) -> Weights | None:
        """Returns weights that came since the last call, the newest only, or None. Never waits.

        Raises:
            TransportError: the publisher refused our keys.
        """
        self._connection.check()
        try:
            data = self._connection.socket.recv(zmq.NOBLOCK)
        except zmq.Again:
            return None
        try:
            message = decode(data, self._generation)
            weights = self._checked(message)
        except MessageError as error:
            self.refusals.count(error.fault, str(error))
            return None
        # A learner that resumed from a checkpoint counts on from a lower version: new is what is different.
        if (weights.version, weights.learner_step) == self._last:
            return None
        self._last = (weights.version, weights.learner_step)
        return weights

    def redirect(self, address: str, generation: int) -> None:
        """Listens to the publisher at another address from now on.

        Raises:
            TransportError: the address cannot be used.
        """
        self._connection.redirect(address)
        self._generation = generation

    def wait(self, timeout_s: float) -> bool:
        """Waits until something has come, up to `timeout_s`; returns whether it has."""
        return bool(self._connection.socket.poll(int(timeout_s * 1000)))

    def close(self) -> None:
        """Closes the socket; may be called twice."""
        self._connection.close()

    def _checked(self, message: object) -> Weights:
        if not isinstance(message, Weights):
            raise MessageError("header", f"a {type(message).__name__} instead of weights")
        if self._expected is not None:
            shapes = {name: array.shape for name, array in message.arrays.items()}
            wrong = {name for name in shapes.keys() | self._expected if shapes.get(name) != self._expected.get(name)}
            if wrong:
                raise MessageError("shape", f"weights of another network; they differ in {', '.join(sorted(wrong))}")
        return message
