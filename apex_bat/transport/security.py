"""CURVE keys of a run and who may connect with them.

`make_keys` writes one file a key. A host of actors needs `server.public`, `client.public` and `client.secret`; only
hosts of servers need `server.secret` and `allowed_clients`, which lists the public keys of the clients let in, one a
line. Encryption alone lets every client in: the authenticator below is what keeps strangers out (RFC 27, ZAP).
"""

from __future__ import annotations

import os
import stat
import struct
from pathlib import Path
from typing import NamedTuple

import zmq
import zmq.auth
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils import z85

from apex_bat.transport.refusals import Refusals

ZAP_DOMAIN = "apex_bat"  # named on socket and authenticator alike: "*" did not match a socket's own domain (measured)
KEY_CHARACTERS, KEY_BYTES = 40, 32  # in Z85 and decoded
MAX_KEY_FILE_BYTES = 1 << 20  # 25,000 allowed clients


class TransportError(RuntimeError):
    """A socket or key cannot be used; the message is one line that says what and what to do."""


class AddressInUseError(TransportError):
    """Somebody else listens there, for the moment or for long."""


class Keys(NamedTuple):
    """CURVE keys, Z85-encoded, 40 characters each."""

    server_public: bytes
    client_public: bytes
    client_secret: bytes
    server_secret: bytes | None = None
    """None on hosts that only connect."""
    allowed_clients: frozenset[bytes] = frozenset()
    """Public keys that servers let in."""

    def of_client(self) -> Keys:
        """Returns what a host needs that only connects."""
        return self._replace(server_secret=None, allowed_clients=frozenset())


def make_keys(folder: Path) -> Keys:
    """Writes new keys of a server and a client into a folder (mode 0700, files 0600) and returns them.

    Raises:
        TransportError: the folder holds keys already, others may enter it, or it cannot be written.
    """
    keys = new_keys()
    _write_keys(
        folder,
        {
            "server.public": keys.server_public,
            "server.secret": keys.server_secret or b"",
            "client.public": keys.client_public,
            "client.secret": keys.client_secret,
            "allowed_clients": keys.client_public,
        },
    )
    return keys


def new_keys() -> Keys:
    """Returns new keys of a server and of the one client that it lets in."""
    server_public, server_secret = zmq.curve_keypair()
    client_public, client_secret = zmq.curve_keypair()
    return Keys(server_public, client_public, client_secret, server_secret, frozenset([client_public]))


def make_client_keys(folder: Path, client_folder: Path) -> Keys:
    """Writes a further client's keys into a folder of its own and lists it among the allowed clients of `folder`.

    A host with keys of its own can be shut out alone: take its line out of `allowed_clients` and start the run anew.

    Raises:
        TransportError: `folder` holds no keys of a server, or `client_folder` holds keys already.
    """
    known = load_keys(folder)
    if known.server_secret is None:
        raise TransportError(f"{folder}: has no server.secret; make the keys of clients where the server's are")
    public, secret = zmq.curve_keypair()
    lines = {"server.public": known.server_public, "client.public": public, "client.secret": secret}
    _write_keys(client_folder, lines)
    try:
        with (folder / "allowed_clients").open("ab") as file:
            file.write(public + b"\n")
    except OSError as error:
        raise TransportError(f"{folder / 'allowed_clients'}: cannot be written: {error.strerror}") from error
    return Keys(known.server_public, public, secret)


def load_keys(folder: Path) -> Keys:
    """Returns the keys of a folder.

    Raises:
        TransportError: a file is missing, is no key, or others than its owner may read or write it or its folder.
    """
    server_secret = None
    allowed: frozenset[bytes] = frozenset()
    try:
        check_private(folder, 0o700)
        is_server = (folder / "server.secret").exists()
    except (OSError, ValueError) as error:
        raise TransportError(f"{folder}: {_reason(error)}; make keys with `apex-bat keys {folder}`") from error
    if is_server:
        server_secret = _read_keys(folder / "server.secret")[0]
        allowed = frozenset(_read_keys(folder / "allowed_clients"))
    return Keys(
        _read_keys(folder / "server.public")[0],
        _read_keys(folder / "client.public")[0],
        _read_keys(folder / "client.secret")[0],
        server_secret,
        allowed,
    )


def check_private(path: Path, mode: int) -> None:
    """Refuses a file or folder that belongs to another user or that others may use; does nothing outside POSIX.

    Args:
        path: what to look at.
        mode: what it should have, for the advice in the message.

    Raises:
        TransportError: somebody else than this user, or root, could read, write or replace what is there.
        OSError: there is nothing.
    """
    status = path.stat()
    if os.name != "posix":
        return
    if status.st_uid not in (os.getuid(), 0):
        raise TransportError(f"{path}: belongs to another user (uid {status.st_uid}); make one of your own")
    found = stat.S_IMODE(status.st_mode)
    if found & 0o077:
        raise TransportError(f"{path}: mode {found:04o} lets other users at it; run `chmod {mode:03o} {path}`")


def start_authenticator(context: zmq.Context[zmq.Socket[bytes]], keys: Keys, refusals: Refusals) -> ThreadAuthenticator:
    """Returns a running authenticator that lets in exactly `keys.allowed_clients`. Start it before binding; stop it."""
    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    allowed = _AllowList(keys.allowed_clients, refusals)
    authenticator.configure_curve_callback(domain=ZAP_DOMAIN, credentials_provider=allowed)
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


class _AllowList:
    """The callback that the authenticator asks: it hands over keys that are Z85-encoded already."""

    def __init__(self, allowed: frozenset[bytes], refusals: Refusals) -> None:
        self._allowed = allowed
        self._refusals = refusals

    def callback(self, domain: str, key: bytes) -> bool:
        if domain == ZAP_DOMAIN and key in self._allowed:
            return True
        self._refusals.count("key", f"the client key {key.decode('ascii', 'replace')} is not in allowed_clients")
        return False


def _write_keys(folder: Path, lines: dict[str, bytes]) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not any(folder.iterdir()):
            folder.chmod(0o700)  # an empty folder that was there already
        check_private(folder, 0o700)
        for name, line in lines.items():
            descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(line + b"\n")
    except FileExistsError as error:
        raise TransportError(
            f"{error.filename}: exists already; give another folder, or remove the old keys"
        ) from error
    except (OSError, ValueError) as error:
        raise TransportError(f"{folder}: keys cannot be written there: {_reason(error)}") from error


def _read_keys(path: Path) -> list[bytes]:
    """Returns the keys of a file, one or more."""
    try:
        check_private(path, 0o600)
        with path.open("rb") as file:
            keys = file.read(MAX_KEY_FILE_BYTES).split()
    except (OSError, ValueError) as error:
        raise TransportError(f"{path}: {_reason(error)}; make keys with `apex-bat keys {path.parent}`") from error
    if not keys or not all(map(_is_key, keys)):
        raise TransportError(f"{path}: holds no CURVE key (40 characters of Z85 a line)")
    return keys


def _is_key(key: bytes) -> bool:
    """Whether these are 40 characters that stand for 32 bytes."""
    if len(key) != KEY_CHARACTERS:
        return False
    try:
        return len(z85.decode(key)) == KEY_BYTES
    except (KeyError, struct.error):  # a character outside Z85, or five that exceed 32 bits
        return False


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
