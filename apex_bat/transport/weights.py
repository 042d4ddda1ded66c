"""Broadcast of the network's weights: newest wins, and who subscribes late gets the newest at once.

A subscriber says what it has and is sent whatever is newer for as long as it says so again: what a full queue dropped,
or a publisher that was replaced did not know, comes with the next renewal. It conflates: of all that has arrived it
keeps the last message only. The age of what it finds was 2.3 ms so, against 4.5 s with a queue of 1,000 (medians,
measured).

The sockets are a ROUTER and DEALERs, not the PUB and SUB that ZeroMQ has for broadcasts. With those whoever connects
can fill the publisher's tree of topics, which libzmq walks whole for each connection that ends, inside whatever call
comes next: strangers who came and went held a learner in `poll(0)` for ever (seen, and made again by the test of the
attacks). Here a stranger who was not told the generation of the address is refused, and leaves nothing behind.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

import numpy as np
import zmq
from numpy.typing import NDArray

from apex_bat.transport.messages import MessageError, Subscription, Weights, decode, encode
from apex_bat.transport.refusals import Refusals
from apex_bat.transport.security import Keys, TransportError
from apex_bat.transport.sockets import MAX_MESSAGE_BYTES, Connection, Listener

logger = logging.getLogger(__name__)

_NOTHING = (-1, 0)  # version and learner step of no weights

HIGH_WATER = 4  # broadcasts queued for one slow subscriber; older ones are of no use
RENEW_S = 1.0  # between two subscriptions of one subscriber
REPEAT_S = 2.0  # after which a subscriber that says it has older weights is sent the same ones again
LAPSE_S = 10.0  # without a renewal until nothing more is sent
MAX_SUBSCRIBERS = 10_000
AT_ONCE = 1000  # subscriptions looked at by one call
MAX_SUBSCRIPTION_BYTES = 1024  # handshakes have 200 to 400, a subscription less than 100


class WeightsPublisher:
    """The learner's end.

    Args:
        address: where to listen; port 0 takes any free one.
        keys: CURVE keys, for an address that is not loopback.
        generation: of this address, repeated in each message.
        clock: seconds, monotonic.

    Attributes:
        address: where it listens.
        refusals: counts of refused connections and messages by reason.

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
        self._generation = generation
        self._clock = clock
        self._newest: zmq.Frame | None = None
        self._newest_is = _NOTHING
        self._subscribers: dict[bytes, _Subscriber] = {}  # by routing id
        self._prune_s = clock() + RENEW_S
        self._listener = Listener(
            zmq.ROUTER,
            address,
            self.refusals,
            keys=keys,
            max_message_bytes=MAX_SUBSCRIPTION_BYTES,
            high_water=HIGH_WATER,
        )
        self.address = self._listener.address

    @property
    def num_subscribers(self) -> int:
        """Subscribers that were heard in the last LAPSE_S, as far as the last call saw."""
        return len(self._subscribers)

    def publish(self, version: int, learner_step: int, arrays: Mapping[str, NDArray[np.float32]]) -> None:
        """Broadcasts weights; they are copied.

        Args:
            version: grows with each broadcast.
            learner_step: updates that these weights have seen.
            arrays: float32 arrays by name.
        """
        contiguous = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in arrays.items()}
        self._newest = zmq.Frame(encode(Weights(version, learner_step, contiguous), self._generation))
        self._newest_is = (version, learner_step)
        now_s = self._clock()
        self._prune(now_s)
        for identity, subscriber in self._subscribers.items():
            self._send(identity, subscriber, now_s)

    def serve(self) -> None:
        """Takes subscriptions, and sends the newest weights to those who do not have them. Call it often."""
        now_s = self._clock()
        if now_s >= self._prune_s:
            self._prune(now_s)
        for _ in range(AT_ONCE):
            try:
                identity, *parts = self._listener.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._take(identity, parts, now_s)

    def close(self) -> None:
        """Closes the socket; may be called twice."""
        self._listener.close()

    def _prune(self, now_s: float) -> None:
        """Forgets those who have not renewed."""
        self._prune_s = now_s + RENEW_S
        lapsed = [key for key, one in self._subscribers.items() if now_s - one.heard_s >= LAPSE_S]
        for identity in lapsed:
            del self._subscribers[identity]

    def _take(self, identity: bytes, parts: list[bytes], now_s: float) -> None:
        if len(parts) != 1:
            self.refusals.count("parts", f"{len(parts)} parts")
            return
        try:
            message = decode(parts[0], self._generation)
        except MessageError as error:
            self.refusals.count(error.fault, str(error))
            return
        if not isinstance(message, Subscription):
            self.refusals.count("unexpected", f"a {type(message).__name__} to a publisher")
            return
        if identity not in self._subscribers and len(self._subscribers) >= MAX_SUBSCRIBERS:
            self.refusals.count("flood", f"more than {MAX_SUBSCRIBERS} subscribers")
            return
        subscriber = self._subscribers.setdefault(identity, _Subscriber())
        subscriber.heard_s = now_s
        has_newest = (message.version, message.learner_step) == self._newest_is
        if not has_newest and now_s - subscriber.sent_s >= REPEAT_S:
            self._send(identity, subscriber, now_s)

    def _send(self, identity: bytes, subscriber: _Subscriber, now_s: float) -> None:
        """Sends the newest weights, if there are any; a full queue drops them, and so does one who has left."""
        if self._newest is not None:
            subscriber.sent_s = now_s
            self._listener.socket.send_multipart([identity, self._newest], zmq.NOBLOCK, copy=False)


class _Subscriber:
    """When a subscriber was heard last, and when it was sent something."""

    def __init__(self) -> None:
        self.heard_s = self.sent_s = float("-inf")


class WeightsSubscriber:
    """An actor's end. It must be asked, or waited with, more often than every LAPSE_S, or it is forgotten meanwhile.

    Args:
        address: of the publisher.
        expected: shape of each array by name, which weights must match exactly; None: anything goes.
        keys: CURVE keys, for an address that is not loopback.
        generation: of the address; weights of another are refused.
        max_message_bytes: a larger message is refused.
        clock: seconds, monotonic.

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
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        options: dict[int, int] = {zmq.CONFLATE: 1}
        self._connection = Connection(
            zmq.DEALER, address, keys=keys, max_message_bytes=max_message_bytes, options=options
        )
        self._expected = None if expected is None else dict(expected)
        self._generation = generation
        self._clock = clock
        self._last = _NOTHING
        self._renew_s = float("-inf")
        self.refusals = Refusals(logger)

    def newest(self) -> Weights | None:
        """Returns weights that came since the last call, the newest only, or None. Never waits.

        Raises:
            TransportError: the publisher refused our keys, or the connection is given up.
        """
        self._connection.check()
        self._subscribe()
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
        self._renew_s = float("-inf")

    def wait(self, timeout_s: float) -> bool:
        """Waits until something has come, up to `timeout_s`; returns whether it has.

        Raises:
            TransportError: the connection is given up, also because the publisher refused our keys.
        """
        self._subscribe()
        return bool(self._connection.socket.poll(int(timeout_s * 1000)))

    def close(self) -> None:
        """Closes the socket; may be called twice."""
        self._connection.close()

    def _subscribe(self) -> None:
        """Says what is here and that what is newer is wanted, if it is time to say so again."""
        now_s = self._clock()
        if now_s >= self._renew_s:
            self._renew_s = now_s + RENEW_S
            try:
                self._connection.socket.send(encode(Subscription(*self._last), self._generation), zmq.NOBLOCK)
            except zmq.Again:  # a DEALER that conflates has room as long as it has a connection, or makes one
                self._connection.check()  # it gives up where the handshake breaks the protocol, too
                raise TransportError(
                    f"{self._connection.address}: the connection for weights was given up: "
                    "they may be larger than transport.max_message_mb"
                ) from None

    def _checked(self, message: object) -> Weights:
        if not isinstance(message, Weights):
            raise MessageError("header", f"a {type(message).__name__} instead of weights")
        if self._expected is not None:
            shapes = {name: array.shape for name, array in message.arrays.items()}
            wrong = {name for name in shapes.keys() | self._expected if shapes.get(name) != self._expected.get(name)}
            if wrong:
                raise MessageError("shape", f"weights of another network; they differ in {', '.join(sorted(wrong))}")
        return message
