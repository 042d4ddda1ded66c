"""Changing the law of a replay server's rate limiter while it runs, from outside."""

from __future__ import annotations

import time

import zmq

from apex_bat.transport.messages import MessageError, Ratio, RatioChange, decode, encode
from apex_bat.transport.security import Keys, TransportError
from apex_bat.transport.sockets import Connection

ASK_AGAIN_S = 1.0


def change_ratio(
    address: str,
    change: RatioChange,
    *,
    generation: int = 0,
    keys: Keys | None = None,
    timeout_s: float = 10.0,
) -> Ratio:
    """Asks a server for another law and returns the one that holds then.

    Raises:
        TransportError: it does not answer, or refused our keys.
        ValueError: it refused the change; the text says why.
    """
    connection = Connection(zmq.DEALER, address, keys=keys)
    try:
        ends_s = time.monotonic() + timeout_s
        while time.monotonic() < ends_s:
            connection.check()
            _ask(connection, encode(change, generation))
            answer = _answer(connection, generation)
            if answer is not None and answer.refused:
                raise ValueError(answer.refused)
            if answer is not None:
                return answer
    finally:
        connection.close()
    raise TransportError(f"no answer from the replay server at {address} within {timeout_s:g} s: is the run going on?")


def _ask(connection: Connection, data: bytearray) -> None:
    try:
        connection.socket.send(data, zmq.NOBLOCK)
    except zmq.Again:
        return  # the queue is full of the same question


def _answer(connection: Connection, generation: int) -> Ratio | None:
    if not connection.socket.poll(int(ASK_AGAIN_S * 1000)):
        return None
    try:
        message = decode(connection.socket.recv(), generation)
    except MessageError:
        return None
    return message if isinstance(message, Ratio) else None
