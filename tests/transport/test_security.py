"""Keys on disk, and who is let in with which."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import zmq

from apex_bat.transport.security import Keys, TransportError, load_keys, make_client_keys, make_keys
from apex_bat.transport.sockets import Connection, Listener


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "keys"


def reaches(listener: Listener, connection: Connection, timeout_ms: int) -> bool:
    connection.socket.send(b"hello", zmq.NOBLOCK)
    return bool(listener.socket.poll(timeout_ms))


def test_keys_are_private_files_that_load_as_they_were_made(folder: Path) -> None:
    keys = make_keys(folder)
    assert load_keys(folder) == keys
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {file.stat().st_mode & 0o777 for file in folder.iterdir()} == {0o600}


@pytest.mark.parametrize("name", ["client.secret", "server.secret", "server.public", "allowed_clients"])
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620])
def test_looser_modes_are_refused(folder: Path, name: str, mode: int) -> None:
    make_keys(folder)
    (folder / name).chmod(mode)
    with pytest.raises(TransportError, match="chmod 600"):
        load_keys(folder)


@pytest.mark.parametrize("mode", [0o750, 0o705, 0o777])
def test_a_folder_of_keys_that_others_may_enter_is_refused(folder: Path, mode: int) -> None:
    make_keys(folder)
    folder.chmod(mode)
    with pytest.raises(TransportError, match="chmod 700"):
        load_keys(folder)


def test_an_empty_folder_is_closed_to_others_and_a_used_one_is_refused(tmp_path: Path) -> None:
    empty, used = tmp_path / "empty", tmp_path / "used"
    for each in (empty, used):
        each.mkdir()
        each.chmod(0o755)
    (used / "file").touch()
    make_keys(empty)
    assert empty.stat().st_mode & 0o777 == 0o700
    with pytest.raises(TransportError, match="chmod 700"):
        make_keys(used)


def test_keys_of_another_user_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_keys(folder)
    for file in (folder, *folder.iterdir()):
        os.chown(file, 12_345, -1) if os.getuid() == 0 else monkeypatch.setattr("os.getuid", lambda: 12_345)
    with pytest.raises(TransportError, match="belongs to another user"):
        load_keys(folder)


def test_a_further_client_gets_keys_of_its_own_and_is_let_in(folder: Path, tmp_path: Path) -> None:
    keys = make_keys(folder)
    other = make_client_keys(folder, tmp_path / "other")
    assert load_keys(tmp_path / "other") == other
    assert other.client_public != keys.client_public
    assert load_keys(folder).allowed_clients == {keys.client_public, other.client_public}
    assert {file.name for file in (tmp_path / "other").iterdir()} == {"server.public", "client.public", "client.secret"}
    with pytest.raises(TransportError, match=r"no server\.secret"):
        make_client_keys(tmp_path / "other", tmp_path / "third")
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", keys=load_keys(folder))
    connection = Connection(zmq.PUSH, listener.address, keys=other)
    try:
        assert reaches(listener, connection, 5000)
    finally:
        connection.close()
        listener.close()


@pytest.mark.parametrize("text", ["x" * 39 + "~", "#####" * 8, ""], ids=["no Z85", "beyond 32 bits", "empty"])
def test_what_is_no_key_is_refused_before_a_socket_sees_it(folder: Path, text: str) -> None:
    make_keys(folder)
    (folder / "client.secret").write_text(text + "\n")
    with pytest.raises(TransportError, match="holds no CURVE key"):
        load_keys(folder)


def test_existing_keys_are_not_overwritten(folder: Path) -> None:
    keys = make_keys(folder)
    with pytest.raises(TransportError, match="exists already"):
        make_keys(folder)
    assert load_keys(folder) == keys


def test_missing_or_broken_keys_are_refused(folder: Path) -> None:
    with pytest.raises(TransportError, match="apex-bat keys"):
        load_keys(folder)
    make_keys(folder)
    (folder / "client.public").write_text("short\n")
    with pytest.raises(TransportError, match="holds no CURVE key"):
        load_keys(folder)


def test_a_host_of_actors_needs_no_secret_of_the_server(folder: Path) -> None:
    make_keys(folder)
    (folder / "server.secret").unlink()
    (folder / "allowed_clients").unlink()
    keys = load_keys(folder)
    assert keys.server_secret is None
    with pytest.raises(TransportError, match=r"no server\.secret"):
        Listener(zmq.PULL, "tcp://127.0.0.1:0", keys=keys)


def test_only_allowed_clients_that_know_the_server_get_through(folder: Path, tmp_path: Path) -> None:
    keys, strangers = make_keys(folder), make_keys(tmp_path / "other")
    not_listed = keys._replace(client_public=strangers.client_public, client_secret=strangers.client_secret)
    wrong_server = keys._replace(server_public=strangers.server_public)
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", keys=keys)
    connections: list[Connection] = []

    def connect(with_keys: Keys | None) -> Connection:
        connections.append(Connection(zmq.PUSH, listener.address, keys=with_keys))
        return connections[-1]

    try:
        for bad in (None, not_listed, wrong_server):
            connect(bad).socket.send(b"stranger", zmq.NOBLOCK)
        assert reaches(listener, connect(keys), 5000)
        assert listener.socket.recv() == b"hello"
        assert not listener.socket.poll(100)
    finally:
        for connection in connections:
            connection.close()
        listener.close()


def test_a_refused_client_is_told(folder: Path, tmp_path: Path) -> None:
    keys, strangers = make_keys(folder), make_keys(tmp_path / "other")
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", keys=keys)
    refused = Connection(
        zmq.PUSH,
        listener.address,
        keys=keys._replace(client_public=strangers.client_public, client_secret=strangers.client_secret),
    )
    try:
        with pytest.raises(TransportError, match="authentication refused"):
            _check_for_seconds(refused, listener)
    finally:
        refused.close()
        listener.close()


def _check_for_seconds(refused: Connection, listener: Listener) -> None:
    for _ in range(500):
        refused.check()
        listener.socket.poll(10)
