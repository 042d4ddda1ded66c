"""What a launcher tells a role on its standard input: addresses and keys at first, later where a server has moved to.

To a process in reserve, which has imported all that its role needs and waits, the first line says which life to begin.
A line of JSON each. A pipe is seen by nobody else, so that keys need no file on the role's host. The line STOP before
the end of the input means that the role is to save and end; an end without it, that its keeper has died. Then nobody is
left who could say when the role has ended, and its replacement waits for it: it must be quick.
"""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from apex_bat.roles.plan import Addresses
from apex_bat.transport.security import Keys, TransportError

STOP = b'"stop"\n'
"""The last line."""
ORPHANED_S = 1.0
"""How long a role whose keeper has died may take for its last files."""
MAX_LINE_BYTES = 1 << 16
"""Of one order: addresses take 500 bytes, 500 allowed clients 22,000."""
FIRST_ORDERS_S = 30.0
"""How long a role waits for its first orders."""
_log = logging.getLogger(__name__)


class GivenKeys(Struct, frozen=True, forbid_unknown_fields=True):
    """`security.Keys` as text; no `repr` of it shows a secret."""

    server_public: str
    client_public: str
    client_secret: str
    server_secret: str | None
    allowed_clients: list[str]

    def __repr__(self) -> str:
        return "GivenKeys(...)"


class Orders(Struct, frozen=True, forbid_unknown_fields=True):
    """One line."""

    addresses: Addresses
    keys: GivenKeys | None = None
    """None: as before; in the first line: none."""


def line_of(addresses: Addresses, keys: Keys | None = None) -> bytes:
    """Returns orders as the line that `StandingOrders` reads."""
    return msgspec.json.encode(Orders(addresses, None if keys is None else _as_text(keys))) + b"\n"


class Life(Struct, frozen=True, forbid_unknown_fields=True):
    """The first line for a process in reserve."""

    incarnation: Annotated[int, Meta(ge=0)]
    flown_steps: Annotated[int, Meta(ge=0)]


def line_of_life(incarnation: int, flown_steps: int) -> bytes:
    """Returns the line that `await_life` reads."""
    return msgspec.json.encode(Life(incarnation, flown_steps)) + b"\n"


def await_life() -> Life | None:
    """Returns the life that a process in reserve is to begin, from standard input; None: it is not needed.

    Raises:
        TransportError: something else came.
    """
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(0, 1)  # no more, or it would take what comes after
        if not byte:
            return None
        line += byte
        if len(line) > MAX_LINE_BYTES:
            break
    try:
        return msgspec.json.decode(line, type=Life)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        raise TransportError(f"standard input: a line of {len(line)} bytes begins no life") from None


class StandingOrders:
    """The orders that are in force: one thread hands in what comes, the role asks."""

    def __init__(self) -> None:
        self._rest = b""
        self._news: deque[Addresses] = deque(maxlen=1)  # what is added meanwhile is not lost, as with a swap
        self._addresses: Addresses | None = None
        self._arrived = threading.Event()
        self.is_orphan = True
        """Whether the end of the orders would mean that whoever gave them has died."""
        self.keys: Keys | None = None
        """CURVE keys of the run; None without."""

    def heed(self, data: bytes) -> None:
        """Takes bytes as they come; a line that is no order is named in the log, without what it says."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_BYTES:
            _log.error("standard input: a line of more than %d bytes is left out", MAX_LINE_BYTES)
            self._rest = b""
        for line in lines:
            try:
                orders = msgspec.json.decode(line, type=Orders | Literal["stop"])
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                _log.error("standard input: a line of %d bytes is no order", len(line))
                continue
            if isinstance(orders, str):
                self.is_orphan = False
                continue
            if orders.keys is not None:
                self.keys = _as_keys(orders.keys)
            if self._arrived.is_set():
                self._news.append(orders.addresses)
            else:
                self._addresses = orders.addresses
                self._arrived.set()

    def first(self, timeout_s: float = FIRST_ORDERS_S) -> Addresses:
        """Returns the addresses of the first orders, waiting for them.

        Raises:
            TransportError: none came.
        """
        self._arrived.wait(timeout_s)
        if self._addresses is None:
            raise TransportError(f"no addresses came on standard input within {timeout_s:g} s")
        return self._addresses

    def moved(self) -> Addresses | None:
        """Returns the newest addresses if they have changed since the last call, else None."""
        try:
            return self._news.popleft()
        except IndexError:
            return None


def _as_text(keys: Keys) -> GivenKeys:
    secret = None if keys.server_secret is None else keys.server_secret.decode()
    allowed = sorted(key.decode() for key in keys.allowed_clients)
    return GivenKeys(
        keys.server_public.decode(), keys.client_public.decode(), keys.client_secret.decode(), secret, allowed
    )


def _as_keys(given: GivenKeys) -> Keys:
    fields: dict[str, Any] = {
        name: value.encode() if isinstance(value, str) else value
        for name, value in msgspec.structs.asdict(given).items()
    }
    return Keys(**fields | {"allowed_clients": frozenset(key.encode() for key in given.allowed_clients)})
