"""CURVE keys of a run and who may connect with them.

`make_keys` writes one file a key. A host of actors needs `server.public`, `client.public` and `client.secret`; only
hosts of servers need `server.secret` and `allowed_clients`, which lists the public keys of the clients let in, one a
line. Encryption alone lets every client in: the authenticator below is what keeps strangers out (RFC 27, ZAP).
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import NamedTuple

import zmq
import zmq.auth
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils.monitor import recv_monitor_message

ZAP_DOMAIN = "apex_bat"  # named on socket and authenticator alike: "*" did not match a socket's own domain (measured)
KEY_CHARACTERS = 40  # Z85 of 32 bytes

_REFUSED_EVENTS = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)


class TransportError(RuntimeError):
    """A socket or key cannot be used; the message is one line that says what and what to do."""


class Keys(NamedTuple):
    """CURVE keys, Z85-encoded, 40 characters each."""

    server_public: bytes
    client_public: bytes
    client_secret: bytes
    server_secret: bytes | None = None
    """None on hosts that only connect."""
    allowed_clients: frozenset[bytes] = frozenset()
    """Public keys that servers let in."""


def make_keys(folder: Path) -> Keys:
    """Writes new keys of a server and a client into a folder (mode 0700, files 0600) and returns them.

    Raises:
        TransportError: the folder holds keys already, or cannot be written.
    """
    server_public, server_secret = zmq.curve_keypair()
    client_public, client_secret = zmq.curve_keypair()
    lines = {
        "server.public": server_public,
        "server.secret": server_secret,
        "client.public": client_public,
        "client.secret": client_secret,
        "allowed_clients": client_public,
    }
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, line in lines.items():
            descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(line + b"\n")
    except FileExistsError as error:
        raise TransportError(
            f"{error.filename}: exists already; give another folder, or remove the old keys"
        ) from error
    except OSError as error:
        raise TransportError(f"{folder}: keys cannot be written there: {error.strerror}") from error
    return Keys(server_public, client_public, client_secret, server_secret, frozenset([client_public]))


def load_keys(folder: Path) -> Keys:
    """Returns the keys of a folder.

    Raises:
        TransportError: a file is missing, is no key, or others than its owner may read or write it.
    """
    server_secret = None
    allowed: frozenset[bytes] = frozenset()
    if (folder / "server.secret").exists():
        server_secret = _read_keys(folder / "server.secret")[0]
        allowed = frozenset(_read_keys(folder / "allowed_clients"))
    return Keys(
        _read_keys(folder / "server.public")[0],
        _read_keys(folder / "client.public")[0],
        _read_keys(folder / "client.secret")[0],
        server_secret,
        allowed,
    )


def start_authenticator(context: zmq.Context[zmq.Socket[bytes]], keys: Keys) -> ThreadAuthenticator:
    """Returns a running authenticator that lets in exactly `keys.allowed_clients`. Start it before binding; stop it."""
    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    authenticator.configure_curve_callback(domain=ZAP_DOMAIN, credentials_provider=_AllowList(keys.allowed_clients))
    return authenticator


def secure_server(socket: zmq.Socket[bytes], keys: Keys) -> None:
    """Makes a socket, before it is bound, speak CURVE as the server.

    Raises:
        TransportError: these keys hold no server secret.
    """
    if keys.server_secret is None:
        raise TransportError("the folder of keys has no server.secret, so that this host cannot run a server")
    socket.curve_server = True
    socket.curve_publickey = keys.server_public
    socket.curve_secretkey = keys.server_secret
    socket.zap_domain = ZAP_DOMAIN.encode()


def secure_client(socket: zmq.Socket[bytes], keys: Keys) -> None:
    """Makes a socket, before it connects, speak CURVE as a client of the server that holds `keys.server_public`."""
    socket.curve_serverkey = keys.server_public
    socket.curve_publickey = keys.client_public
    socket.curve_secretkey = keys.client_secret


class HandshakeWatch:
    """Notices that a server refuses us: the socket itself would retry in silence for ever."""

    def __init__(self, socket: zmq.Socket[bytes], address: str) -> None:
        self._address = address
        self._socket = socket
        self._monitor: zmq.Socket[bytes] = socket.get_monitor_socket(_REFUSED_EVENTS)

    def check(self) -> None:
        """Raises TransportError if a handshake failed since the last call."""
        refused = False
        while self._monitor.poll(0):
            recv_monitor_message(self._monitor)
            refused = True
        if refused:
            raise TransportError(f"{self._address}: authentication refused; are the keys those of this run?")

    def close(self) -> None:
        """Ends the watch; call it before the socket is closed."""
        self._socket.disable_monitor()


class _AllowList:
    """The callback that the authenticator asks: it hands over keys that are Z85-encoded already."""

    def __init__(self, allowed: frozenset[bytes]) -> None:
        self._allowed = allowed

    def callback(self, domain: str, key: bytes) -> bool:
        return domain == ZAP_DOMAIN and key in self._allowed


def _read_keys(path: Path) -> list[bytes]:
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        if os.name == "posix" and mode & 0o077:
            raise TransportError(f"{path}: mode {mode:04o} lets others at the key; run `chmod 600 {path}`")
        keys = path.read_bytes().split()
    except OSError as error:
        raise TransportError(f"{path}: {error.strerror}; make keys with `apex-bat keys {path.parent}`") from error
    if not keys or any(len(key) != KEY_CHARACTERS for key in keys):
        raise TransportError(f"{path}: holds no CURVE key (40 characters a line)")
    return keys
