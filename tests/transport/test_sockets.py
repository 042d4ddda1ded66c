"""Who may listen where, and what a socket lets through."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import zmq

from apex_bat.transport.security import Keys, TransportError
from apex_bat.transport.sockets import Connection, Listener, check_address, is_loopback

SOME_KEYS = Keys(b"x" * 40, b"y" * 40, b"z" * 40)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:0", "tcp://127.9.9.9:80", "tcp://localhost:80", "tcp://[::1]:80"])
def test_loopback_needs_no_keys(address: str) -> None:
    check_address(address, None)


def test_a_loopback_address_that_all_users_can_reach_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    check_address("tcp://127.0.0.1:0", SOME_KEYS)
    check_address("tcp://127.0.0.1:0", None, listening=False)
    assert not caplog.records
    check_address("tcp://127.0.0.1:0", None)
    assert "every user of this machine can connect" in caplog.text


@pytest.mark.parametrize("address", ["tcp://0.0.0.0:0", "tcp://*:0", "tcp://192.168.1.2:80", "tcp://example.org:80"])
def test_any_other_address_needs_keys(address: str) -> None:
    with pytest.raises(TransportError, match=r"needs CURVE keys.*apex-bat keys"):
        check_address(address, None)
    with pytest.raises(TransportError, match="needs CURVE keys"):
        check_address(address, None, listening=False)
    check_address(address, SOME_KEYS)


@pytest.mark.parametrize(
    "address",
    ["", "tcp://", "tcp://host", "tcp://host:", "tcp://host:x", "tcp://h:70000", "ipc://relative", "udp://h:1"],
)
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(TransportError, match="not an address"):
        check_address(address, SOME_KEYS)


def test_a_connection_that_is_redirected_leaves_the_one_and_goes_to_the_other() -> None:
    former, next_one = (Listener(zmq.PULL, "tcp://127.0.0.1:0") for _ in range(2))
    connection = Connection(zmq.PUSH, former.address)
    try:
        connection.socket.send(b"1")
        assert former.socket.poll(10_000)
        connection.redirect(next_one.address)
        assert connection.address == next_one.address
        connection.socket.send(b"2")
        assert next_one.socket.poll(10_000)
        assert next_one.socket.recv() == b"2"
        with pytest.raises(TransportError, match="needs CURVE keys"):
            connection.redirect("tcp://192.0.2.1:5000")
    finally:
        for each in (connection, former, next_one):
            each.close()


@pytest.mark.parametrize("host", ["10.0.0.1", "localhost.example.org", "128.0.0.1"])
def test_other_hosts_are_not_loopback(host: str) -> None:
    assert not is_loopback(host)


@pytest.mark.skipif(os.name != "posix", reason="ipc is for POSIX")
def test_an_ipc_folder_that_others_may_enter_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    with pytest.raises(TransportError, match="chmod 700"):
        Listener(zmq.PULL, f"ipc://{tmp_path}/x")
    with pytest.raises(TransportError, match="no folder"):
        check_address(f"ipc://{tmp_path}/absent/x", None)
    tmp_path.chmod(0o700)
    Listener(zmq.PULL, f"ipc://{tmp_path}/x").close()


def test_an_ipc_path_that_is_too_long_is_refused() -> None:
    with pytest.raises(TransportError, match="shorter folder"):
        check_address("ipc:///" + "x" * 107, None)


def test_a_port_in_use_is_one_clear_line() -> None:
    first = Listener(zmq.PULL, "tcp://127.0.0.1:0")
    try:
        with pytest.raises(TransportError, match=r"the port is in use; choose another transport\.base_port") as caught:
            Listener(zmq.PULL, first.address)
        assert "\n" not in str(caught.value)
    finally:
        first.close()


def test_a_free_port_is_told() -> None:
    one = Listener(zmq.PULL, "tcp://127.0.0.1:0")
    one.close()
    one.close()
    assert one.address.startswith("tcp://127.0.0.1:")
    assert not one.address.endswith(":0")


def test_queues_are_bounded_and_nothing_lingers() -> None:
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0")
    connection = Connection(zmq.PUSH, listener.address, high_water=3)
    try:
        accepted = 0
        while accepted < 10_000:
            try:
                connection.socket.send(bytes(100_000), zmq.NOBLOCK)
            except zmq.Again:
                break
            accepted += 1
        assert accepted < 1000  # the receiver reads nothing: its queue of 64, the sender's 3 and the kernel's buffers
        assert connection.socket.linger == 0
    finally:
        connection.close()
        connection.close()
        listener.close()


def test_an_oversized_message_is_not_received() -> None:
    listener = Listener(zmq.PULL, "tcp://127.0.0.1:0", max_message_bytes=1000)
    large, small = Connection(zmq.PUSH, listener.address), Connection(zmq.PUSH, listener.address)
    try:
        large.socket.send(bytes(1001))
        small.socket.send(bytes(1000))
        assert listener.socket.poll(5000)
        assert listener.socket.recv() == bytes(1000)
        assert not listener.socket.poll(50)
    finally:
        large.close()
        small.close()
        listener.close()


FILLS = """
import sys, time, zmq
from apex_bat.transport.sockets import Connection

connection = Connection(zmq.DEALER, sys.argv[1], high_water=1000)
for _ in range(300):
    connection.socket.send(bytes(1000))
print("full", flush=True)
time.sleep(60)
"""
OUTLIVES = """
import subprocess, sys, time, zmq
from apex_bat.transport.sockets import Listener

listener = Listener(zmq.ROUTER, sys.argv[1])
peer = subprocess.Popen([sys.executable, "-c", sys.argv[2], listener.address], stdout=subprocess.PIPE)
assert peer.stdout is not None and peer.stdout.readline().strip() == b"full"
time.sleep(1.0)
peer.kill()
peer.wait()
time.sleep(1.5)  # what ZeroMQ does each second, it does in this time
received = 0
while listener.socket.poll(200):
    listener.socket.recv_multipart()
    received += 1
listener.close()
print("received", received > 0)
"""


@pytest.mark.skipif(os.name != "posix", reason="Unix sockets")
@pytest.mark.parametrize("kind", ["ipc", "tcp"])
def test_a_peer_that_dies_with_a_full_queue_does_not_end_the_listener(kind: str, tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    address = f"ipc://{tmp_path}/socket" if kind == "ipc" else "tcp://127.0.0.1:0"
    done = subprocess.run([sys.executable, "-c", OUTLIVES, address, FILLS], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr  # libzmq ends the whole process where an assertion of its own fails
    assert done.stdout == "received True\n"
