"""Both ends notice a refused handshake, and a server outlives those who never finish one."""

from __future__ import annotations

import logging
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zmq

from apex_bat.transport import sockets
from apex_bat.transport.messages import Report
from apex_bat.transport.refusals import Refusals
from apex_bat.transport.reports import ReportCollector, Reporter
from apex_bat.transport.security import Keys, TransportError, make_keys
from apex_bat.transport.sockets import Connection, Listener

WAIT_S = 20.0


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return make_keys(tmp_path_factory.mktemp("keys") / "ours")


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return make_keys(tmp_path_factory.mktemp("keys") / "theirs")


@pytest.fixture
def refusals() -> Refusals:
    return Refusals(logging.getLogger("test"))


def until(condition: Callable[[], object]) -> None:
    ends_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < ends_s, "it did not happen in time"
        time.sleep(0.005)


def reason_of_refusal(connection: Connection) -> str:
    found: list[str] = []

    def is_refused() -> bool:
        try:
            connection.check()
        except TransportError as error:
            found.append(str(error))
        return bool(found)

    until(is_refused)
    return found[0]


def test_a_client_that_is_not_listed_is_told_and_counted_under_its_key(
    keys: Keys, strangers: Keys, refusals: Refusals, caplog: pytest.LogCaptureFixture
) -> None:
    not_listed = keys._replace(client_public=strangers.client_public, client_secret=strangers.client_secret)
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", refusals, keys=keys)
    refused = Connection(zmq.PUSH, listener.address, keys=not_listed)
    try:
        assert "not in the server's allowed_clients" in reason_of_refusal(refused)
        until(lambda: refusals.counts.get("key"))
        assert strangers.client_public.decode() in caplog.text
    finally:
        refused.close()
        listener.close()


@pytest.mark.parametrize("case", ["another server's key", "no keys here", "no keys there"])
def test_a_client_that_the_server_cannot_understand_is_told_within_seconds_and_counted(
    keys: Keys, strangers: Keys, refusals: Refusals, case: str
) -> None:
    ours = {"another server's key": keys._replace(server_public=strangers.server_public), "no keys here": None}
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", refusals, keys=None if case == "no keys there" else keys)
    refused = Connection(zmq.PUSH, listener.address, keys=ours.get(case, keys))
    try:
        assert "authentication refused" in reason_of_refusal(refused)
        assert refusals.counts["handshake"] >= 1
    finally:
        refused.close()
        listener.close()


def test_a_role_whose_reports_are_refused_says_so(keys: Keys, strangers: Keys) -> None:
    collector = ReportCollector("tcp://127.0.0.1:0", keys=keys)
    not_listed = keys._replace(client_public=strangers.client_public, client_secret=strangers.client_secret)
    reporter = Reporter(collector.address, keys=not_listed)

    def is_told() -> bool:
        try:
            reporter.send(Report("actor-0", 1, "h", "a", "s", {}))
        except TransportError:
            return True
        return False

    try:
        until(is_told)
    finally:
        reporter.close()
        collector.close()


@pytest.fixture
def silent_server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


def test_a_server_that_hangs_has_not_refused_us(silent_server: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sockets, "HANDSHAKE_MS", 20)
    connection = Connection(zmq.PUSH, f"tcp://127.0.0.1:{silent_server.getsockname()[1]}")
    accepted = []
    try:
        for _ in range(8):  # each a handshake that the last one timed out of
            accepted.append(silent_server.accept()[0])
            connection.check()
    finally:
        connection.close()
        for each in accepted:
            each.close()


def test_connections_that_say_nothing_are_closed_and_counted(
    refusals: Refusals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sockets, "HANDSHAKE_MS", 100)
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", refusals)
    host, _, port = listener.address.removeprefix("tcp://").rpartition(":")
    silent = [socket.create_connection((host, int(port))) for _ in range(20)]
    try:
        for each in silent:
            each.settimeout(WAIT_S)
            while each.recv(4096):  # the greeting, then the end
                pass
        until(lambda: refusals.counts.get("handshake") == 20)
        assert listener.num_ended == 0
    finally:
        for each in silent:
            each.close()
        listener.close()


def test_a_connection_that_ends_after_its_handshake_is_counted_apart(refusals: Refusals) -> None:
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", refusals, max_message_bytes=10)
    connection = Connection(zmq.PUSH, listener.address)
    try:
        connection.socket.send(bytes(11))
        until(lambda: listener.num_ended)
        assert refusals.total == 0
    finally:
        connection.close()
        listener.close()


FLOODED = """
import resource, socket, sys, zmq
resource.setrlimit(resource.RLIMIT_NOFILE, (120, 120))
from apex_bat.transport.sockets import Listener
listener = Listener(zmq.PULL, "tcp://127.0.0.1:0")
print(listener.address, flush=True)
for _ in range(2):  # one message during the flood, one after it by somebody new
    assert listener.socket.poll(60_000)
    print(listener.socket.recv().decode(), flush=True)
listener.close()
"""


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_NOFILE"), reason="no limit of open files here")
def test_a_server_without_any_file_left_serves_those_who_are_in_and_recovers() -> None:
    server = subprocess.Popen([sys.executable, "-c", FLOODED], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    address = server.stdout.readline().strip()
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    flood: list[socket.socket] = []
    inside = Connection(zmq.PUSH, address, options={zmq.IMMEDIATE: 1})
    try:
        assert inside.socket.poll(20_000, zmq.POLLOUT)
        for _ in range(200):
            flood.append(socket.socket())
            flood[-1].setblocking(False)
            flood[-1].connect_ex((host, int(port)))
        until(lambda: len(list(Path(f"/proc/{server.pid}/fd").iterdir())) >= 118)
        inside.socket.send(b"inside")
        assert server.stdout.readline() == "inside\n"
        for each in flood:
            each.close()
        with closing(Connection(zmq.PUSH, address)) as late:
            late.socket.send(b"late")
            assert server.stdout.readline() == "late\n"
    finally:
        inside.close()
        server.kill()
        server.wait()
        server.stdout.close()


def test_as_many_files_may_be_open_as_the_system_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1024, 1_000_000))
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: asked.append(limits))
    sockets.raise_file_limit()
    assert asked == [(sockets.MAX_FILES, 1_000_000)]
