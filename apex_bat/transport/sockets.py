"""Sockets that are bounded in every direction, and the rule of who may listen where.

An `ipc` address must lie in a folder that only its owner can enter. A TCP address that is not loopback needs CURVE
keys; a loopback address without them is taken with a warning, because every user of the machine can connect to it.
Queues, kernel buffers and message sizes are bounded, the kernel notices dead peers, connections that do not introduce
themselves are closed, and nothing lingers when a socket is closed.

ZeroMQ's own heartbeats stay off: with them libzmq 4.3.5 aborts the process when a peer
dies whose messages have filled the queue (its issues 3937, 4364 and 4767, open). TCP's keepalive and user timeout
notice a pulled cable as well, and a Unix socket has none to pull.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import time
from contextlib import suppress
from pathlib import Path

import zmq

from apex_bat.config.settings import Transport
from apex_bat.transport.refusals import Refusals
from apex_bat.transport.security import (
    AddressInUseError,
    Keys,
    TransportError,
    check_private,
    secure_client,
    secure_server,
    start_authenticator,
)
from apex_bat.transport.watching import AcceptWatch, HandshakeWatch

logger = logging.getLogger(__name__)

MAX_MESSAGE_BYTES = Transport().max_message_bytes
HIGH_WATER = 64  # messages queued in each direction of a connection
KERNEL_BUFFER_BYTES = 1 << 18  # without it the kernel took 115 messages past a high-water mark of 10 (measured)
KEEPALIVE_S = 1  # of silence until TCP asks whether the peer is there, and between its questions
LEAVE_S = 1.0  # at most, until a peer that was left takes no more messages
LOST_MS = (
    4000  # without an answer to data or question, after which a peer counts as gone: a pulled cable shows no other
)
RECONNECT_MS = 50
RECONNECT_MAX_MS = 1000
HANDSHAKE_MS = 5000  # a connection that has not introduced itself by then is closed
BACKLOG = 1024  # connections that wait to be accepted: a burst of strangers fills the usual 100 for a second (measured)
MAX_FILES = 65_536  # open files that a listening process asks for: each connection, even a silent one, is one
MAX_IPC_CHARACTERS = 107  # of the path of a Unix socket

Socket = zmq.Socket[bytes]


class Listener:
    """A bound socket with a context of its own, and the authenticator of that context.

    Args:
        kind: of socket, such as zmq.ROUTER.
        address: where to listen, see `check_address`; port 0 takes any free one.
        refusals: where refused connections are counted.
        keys: CURVE keys.
        max_message_bytes: a peer that announces a larger message is disconnected before memory is taken for it.
        high_water: messages queued in each direction of a connection.
        options: further options of ZeroMQ.

    Attributes:
        socket: the socket.
        address: where it really listens; a port given as 0 is filled in.

    Raises:
        TransportError: the address cannot be used, with the reason.
    """

    def __init__(
        self,
        kind: int,
        address: str,
        refusals: Refusals | None = None,
        *,
        keys: Keys | None = None,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
        high_water: int = HIGH_WATER,
        options: dict[int, int] | None = None,
    ) -> None:
        check_address(address, keys)
        raise_file_limit()
        refusals = refusals or Refusals(logger)
        self._context: zmq.Context[Socket] = zmq.Context()
        self._authenticator = start_authenticator(self._context, keys, refusals) if keys else None
        self.socket: Socket = self._context.socket(kind)
        self._watch: AcceptWatch | None = AcceptWatch(self.socket, refusals)
        self._num_ended = 0
        try:
            _bound(self.socket, address, max_message_bytes, high_water, options)
            if keys:
                secure_server(self.socket, keys)
            self.address = _bind(self.socket, address)
        except TransportError:
            self.close()
            raise

    @property
    def num_ended(self) -> int:
        """Connections that were open and ended, see `AcceptWatch`."""
        return self._num_ended if self._watch is None else self._watch.num_ended

    def close(self) -> None:
        """Closes socket, authenticator and context; may be called twice."""
        if self._watch is not None:
            self._watch.close()
            self._num_ended = self._watch.num_ended
            self._watch = None
        self.socket.close(linger=0)
        if self._authenticator is not None:
            self._authenticator.stop()
            self._authenticator = None
        self._context.destroy(linger=0)


class Connection:
    """A socket that connects, and keeps connecting, to one address; to another one after `redirect`.

    Attributes:
        socket: the socket.
        address: of the peer.
    """

    def __init__(
        self,
        kind: int,
        address: str,
        *,
        keys: Keys | None = None,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
        high_water: int = HIGH_WATER,
        options: dict[int, int] | None = None,
    ) -> None:
        check_address(address, keys, listening=False)
        self.address = address
        self._keys = keys
        self._context: zmq.Context[Socket] = zmq.Context()
        self.socket: Socket = self._context.socket(kind)
        _bound(self.socket, address, max_message_bytes, high_water, options)
        self._watch: HandshakeWatch | None = HandshakeWatch(self.socket, address)
        if keys:
            secure_client(self.socket, keys)
        try:
            self.socket.connect(address)
        except zmq.ZMQError as error:
            self.close()
            raise TransportError(f"{address}: cannot connect: {error.strerror}") from error

    def redirect(self, address: str) -> None:
        """Leaves the peer, which has moved or was replaced, for another address; what was queued for it is lost.

        Raises:
            TransportError: the address cannot be used.
        """
        check_address(address, self._keys, listening=False)
        if address == self.address:
            return
        with suppress(zmq.ZMQError):  # of an address that the socket has given up by itself
            self.socket.disconnect(self.address)
        # With IMMEDIATE the former pipe goes later, by ZeroMQ's own thread, and would swallow what is sent till then.
        ends_s = time.monotonic() + LEAVE_S
        while self.socket.poll(0, zmq.POLLOUT) and time.monotonic() < ends_s:
            time.sleep(0.001)
        self.address = address
        if self._watch is not None:
            self._watch.begin_anew(address)
        try:
            self.socket.connect(address)
        except zmq.ZMQError as error:
            raise TransportError(f"{address}: cannot connect: {error.strerror}") from error

    def check(self) -> None:
        """Raises TransportError if the server has refused us."""
        if self._watch is not None:
            self._watch.check()

    def close(self) -> None:
        """Closes socket and context; may be called twice."""
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        self.socket.close(linger=0)
        self._context.destroy(linger=0)


def check_address(address: str, keys: Keys | None, *, listening: bool = True) -> None:
    """Refuses an address that is not safe, or no address.

    Args:
        address: `ipc:///absolute/path` or `tcp://host:port`; port 0 means any free one.
        keys: the run's keys, or None.
        listening: whether it is to be bound; only then the folder of an ipc address is examined.

    Raises:
        TransportError: with the reason and what to do.
    """
    scheme, _, rest = address.partition("://")
    if scheme == "ipc" and rest.startswith("/"):
        if len(os.fsencode(rest)) > MAX_IPC_CHARACTERS:
            raise TransportError(f"{address}: longer than {MAX_IPC_CHARACTERS} characters; choose a shorter folder")
        if listening:
            _check_folder(Path(rest).parent)
        return
    host, _, port = rest.rpartition(":")
    if scheme != "tcp" or not host or not (port.isdecimal() and int(port) <= 65_535):
        raise TransportError(f"{address}: not an address; give ipc:///folder/name or tcp://host:port")
    if keys is None and not is_loopback(host):
        raise TransportError(
            f"{address}: not a loopback address, so it needs CURVE keys; "
            "make them with `apex-bat keys FOLDER` and set transport.keys"
        )
    if keys is None and listening:
        logger.warning("%s: every user of this machine can connect; use transport.host=ipc or transport.keys", address)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a host name or address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def raise_file_limit() -> None:
    """Asks for as many open files as the system allows, up to MAX_FILES; does nothing where there is no such limit."""
    if os.name != "posix":
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_FILES if hard == resource.RLIM_INFINITY else min(MAX_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError):  # a system that allows less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _check_folder(folder: Path) -> None:
    """Refuses a folder of sockets that others may enter: who can enter it can connect."""
    try:
        check_private(folder, 0o700)
    except OSError as error:
        raise TransportError(f"{folder}: no folder for sockets: {error.strerror}") from error


def _bound(
    socket: Socket, address: str, max_message_bytes: int, high_water: int, options: dict[int, int] | None
) -> None:
    settings = {
        zmq.LINGER: 0,
        zmq.SNDHWM: high_water,
        zmq.RCVHWM: high_water,
        zmq.SNDBUF: KERNEL_BUFFER_BYTES,
        zmq.RCVBUF: KERNEL_BUFFER_BYTES,
        zmq.MAXMSGSIZE: max_message_bytes,
        zmq.TCP_KEEPALIVE: 1,
        zmq.TCP_KEEPALIVE_IDLE: KEEPALIVE_S,
        zmq.TCP_KEEPALIVE_INTVL: KEEPALIVE_S,
        zmq.TCP_KEEPALIVE_CNT: LOST_MS // (1000 * KEEPALIVE_S) - 1,
        zmq.TCP_MAXRT: LOST_MS,
        zmq.HANDSHAKE_IVL: HANDSHAKE_MS,
        zmq.BACKLOG: BACKLOG,
        zmq.RECONNECT_IVL: RECONNECT_MS,
        zmq.RECONNECT_IVL_MAX: RECONNECT_MAX_MS,
        zmq.IPV6: int("[" in address),  # switched on for all, it would show 127.0.0.1 as ::ffff:127.0.0.1
    }
    for option, value in (settings | (options or {})).items():
        socket.setsockopt(option, value)


def _bind(socket: Socket, address: str) -> str:
    try:
        socket.bind(address)
    except zmq.ZMQError as error:
        if error.errno == zmq.EADDRINUSE:
            reason = "the port is in use; choose another transport.base_port, or 0 for any free port"
            raise AddressInUseError(f"{address}: {reason}") from error
        raise TransportError(f"{address}: cannot listen there: {error.strerror}") from error
    return socket.getsockopt_string(zmq.LAST_ENDPOINT)
