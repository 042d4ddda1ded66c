"""What a hostile peer may do to a listening socket, one shot at a time: for the test and the benchmark of hostility.

Each attack is made from a target and returns a function that does it once. A *stranger* does not know the generation of
the address and has no keys; an *insider* knows the generation, and so gets past the first check of a message.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import msgspec
import numpy as np
import zmq

from apex_bat.transport.framing import MAGIC, PREFIX, PROTOCOL
from apex_bat.transport.messages import Insert, PriorityUpdate, Report, SampleRequest, Subscription, Weights, encode
from benchmarks.replay import synthetic_chunk

MAX_OPEN = 400  # connections that one attacker holds open; the oldest is let go
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)  # ZMTP 3.0
Shot = Callable[[], None]


class Target(NamedTuple):
    """Where to, and what is known of it."""

    address: str
    """tcp://host:port"""
    generation: int
    """What an insider knows; a stranger sends 0."""
    max_message_bytes: int
    """What the socket takes."""
    kind: int
    """Type of the attacker's own socket."""


def silent_connections(target: Target) -> Shot:
    """Connects and says nothing."""
    held: deque[socket.socket] = deque()

    def shoot() -> None:
        held.append(_connect(target))
        if len(held) > MAX_OPEN:
            held.popleft().close()

    return shoot


def random_bytes(target: Target) -> Shot:
    """Sends 256 random bytes, sometimes behind a right greeting, and leaves."""
    generator = np.random.default_rng(0)

    def shoot() -> None:
        with suppress(OSError), _connect(target) as connection:
            connection.sendall((GREETING if generator.random() < 0.5 else b"") + generator.bytes(256))

    return shoot


def claimed_size(target: Target) -> Shot:
    """Introduces itself rightly, announces a message of a terabyte and leaves."""
    names = {zmq.DEALER: b"DEALER", zmq.PUSH: b"PUSH"}
    kind = names[zmq.SocketType(target.kind)]
    ready = b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind

    def shoot() -> None:
        with suppress(OSError), _connect(target) as connection:
            connection.sendall(GREETING + b"\x04" + bytes([len(ready)]) + ready)
            connection.recv(64)
            connection.sendall(b"\x02" + (1 << 40).to_bytes(8, "big") + bytes(64))

    return shoot


def _sending(*parts: bytes, generation: int | None = None) -> Callable[[Target], Shot]:
    """Returns an attack that sends a message; with a generation of None the target's is put into it."""

    def attack(target: Target) -> Shot:
        attacker = _socket(target)
        first = bytearray(parts[0])
        if generation is None and len(first) >= PREFIX.size:
            PREFIX.pack_into(first, 0, *PREFIX.unpack_from(first)[:-1], target.generation)
        message = [bytes(first), *parts[1:]]

        def shoot() -> None:
            with suppress(zmq.Again):
                attacker.send_multipart(message, zmq.NOBLOCK)

        return shoot

    return attack


def oversized(target: Target) -> Shot:
    """Sends a message that is a little larger than allowed."""
    return _sending(b"\x02" * (target.max_message_bytes + 1))(target)


def _insert(value: float = 0.5, sequence: int = 1) -> bytes:
    chunk = synthetic_chunk(np.random.default_rng(0))
    chunk.rewards[0] = value
    return bytes(encode(Insert("hostile", 1, sequence, 1, 0, (chunk,))))


def _lying() -> bytes:
    header = {"kind": "weights", "version": 1, "learner_step": 1, "names": ["a"], "shapes": [[1 << 20, 1 << 20]]}
    data = msgspec.msgpack.encode(header)
    return PREFIX.pack(MAGIC, PROTOCOL, 0, len(data), 0, 0) + data + bytes(-(PREFIX.size + len(data)) % 8)


_UNKNOWN_ITEMS = PriorityUpdate(0, np.arange(512) + 2**40, np.ones(512, np.float32))
_REPORT = encode(Report("nobody", 1, "h", "a", "s", {}))
_SUBSCRIPTION = bytes(encode(Subscription(-1, 0)))
_VERSION = bytearray(_insert())
_VERSION[4:6] = b"\x09\x00"

MESSAGES: dict[str, Callable[[Target], Shot]] = {
    "foreign bytes": _sending(b"\x80\x04pickle" * 100, generation=0),
    "truncated": _sending(_insert()[:-8]),
    "wrong version": _sending(bytes(_VERSION)),
    "unknown generation": _sending(_insert(), generation=0),
    "lying shapes": _sending(_lying()),
    "five parts": _sending(_insert(), b"", b"a", b"b", b"c"),
}
"""Attacks with messages that every socket refuses."""

CONNECTIONS: dict[str, Callable[[Target], Shot]] = {
    "silent connections": silent_connections,
    "random bytes": random_bytes,
    "claimed size": claimed_size,
}
"""Attacks before a message."""

ON_REPLAY = {
    **CONNECTIONS,
    "oversized": oversized,
    **MESSAGES,
    "not finite": _sending(_insert(np.nan)),
    "replayed insert": _sending(_insert()),
    "unknown items": _sending(bytes(encode(_UNKNOWN_ITEMS))),
    "requests of a stranger": _sending(bytes(encode(SampleRequest(1, 64, 0))), generation=0),
    "requests for other batches": _sending(bytes(encode(SampleRequest(1, 65_536, 0)))),
    "wrong socket": _sending(bytes(encode(Weights(1, 1, {"a": np.ones(1000, np.float32)})))),
}
ON_REPORTS = {
    **CONNECTIONS,
    "oversized": oversized,
    **MESSAGES,
    "unknown role": _sending(bytes(_REPORT)),
    "wrong socket": _sending(_insert()),
}
ON_WEIGHTS = {
    **CONNECTIONS,
    "oversized": oversized,
    "foreign bytes": MESSAGES["foreign bytes"],
    "truncated": _sending(_SUBSCRIPTION[:-8]),
    "lying shapes": MESSAGES["lying shapes"],
    "five parts": _sending(_SUBSCRIPTION, b"", b"a", b"b", b"c"),
    "subscriptions of a stranger": _sending(_SUBSCRIPTION, generation=0),
    "subscriptions": _sending(_SUBSCRIPTION),
    "wrong socket": _sending(bytes(encode(SampleRequest(1, 64, 0)))),
}


def _connect(target: Target) -> socket.socket:
    host, _, port = target.address.removeprefix("tcp://").rpartition(":")
    return socket.create_connection((host, int(port)), timeout=1.0)


def _socket(target: Target) -> zmq.Socket[bytes]:
    attacker: zmq.Socket[bytes] = zmq.Context.instance().socket(target.kind)
    attacker.setsockopt(zmq.LINGER, 0)
    attacker.setsockopt(zmq.SNDHWM, 10)
    attacker.setsockopt(zmq.RCVHWM, 10)
    attacker.setsockopt(zmq.RECONNECT_IVL, 50)
    attacker.connect(target.address)
    return attacker
