"""The actor's end: windows, silence, servers that die, twins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from apex_bat.config.settings import Config
from apex_bat.experience import Chunk
from apex_bat.replay.server import ReplayServer
from apex_bat.replay.writer import ReplayWriter
from apex_bat.transport.security import TransportError
from apex_bat.transport.sockets import Listener

MakeChunk = Callable[..., Chunk]
Until = Callable[..., None]


@pytest.fixture
def free_running(config: Config) -> Config:
    """Settings in which nobody waits."""
    return msgspec.structs.replace(
        config, replay=msgspec.structs.replace(config.replay, never_block=True, capacity=100_000)
    )


@pytest.fixture
def address(tmp_path: Path) -> str:
    """An address at which one server after another can listen."""
    tmp_path.chmod(0o700)
    return f"ipc://{tmp_path}/r"


@pytest.fixture
def writer(address: str) -> Iterator[ReplayWriter]:
    one = ReplayWriter(address, "a", window_chunks=4, resend_s=0.05)
    yield one
    one.close()


def serving(config: Config, address: str) -> ReplayServer:
    return ReplayServer(config, address, np.random.default_rng(0))


def test_a_slow_server_stops_a_fast_actor_and_loses_nothing(
    config: Config, address: str, writer: ReplayWriter, make_chunk: MakeChunk, until: Until
) -> None:
    server = serving(config, address)
    sent = 0
    try:
        # Nobody samples, so the limiter lets few inserts in: the actor must come to a halt with its window full.
        for _ in range(40):
            if writer.has_room:
                writer.send([make_chunk(10)], 0)
                sent += 10
            writer.poll(0.0)
            server.serve(0.002)
        assert not writer.has_room
        stored = server.metrics()["replay.inserted"]
        assert sent == stored + 40
        with pytest.raises(ValueError, match="window is full"):
            writer.send([make_chunk(10)], 0)
        until(
            lambda: "actors wait for the learner" in writer.waiting,
            lambda: server.serve(0.01),
            lambda: writer.poll(0.0),
        )
        server.store.limiter.change(0.001, 1000.0)
        until(lambda: not writer.unacknowledged, lambda: server.serve(0.01), lambda: writer.poll(0.0))
        assert writer.acknowledged == sent == server.metrics()["replay.inserted"]
        assert writer.waiting == ""
    finally:
        server.close()


def test_what_a_killed_server_had_not_acknowledged_is_stored_once_by_the_next(
    free_running: Config, address: str, writer: ReplayWriter, make_chunk: MakeChunk, until: Until, tmp_path: Path
) -> None:
    first = ReplayServer(free_running, address, np.random.default_rng(0), tmp_path / "snapshot")
    writer.send([make_chunk(10)], 0)
    until(lambda: writer.acknowledged == 10, lambda: first.serve(0.01), lambda: writer.poll(0.0))
    writer.send([make_chunk(10)], 0)
    until(lambda: first.metrics()["replay.inserted"] == 20, lambda: first.serve(0.01), lambda: writer.poll(0.0))
    first.save()
    first.close()  # the answer to the second is on its way, or lost
    for _ in range(2):
        writer.send([make_chunk(10)], 0)
    second = ReplayServer(free_running, address, np.random.default_rng(0), tmp_path / "snapshot")
    try:
        second.restore()
        until(lambda: not writer.unacknowledged, lambda: second.serve(0.01), lambda: writer.poll(0.01))
        assert writer.acknowledged == 40
        assert second.metrics()["replay.inserted"] == 40
    finally:
        second.close()


def test_a_server_without_memory_takes_what_is_left_in_the_window(
    free_running: Config, address: str, writer: ReplayWriter, make_chunk: MakeChunk, until: Until
) -> None:
    first = serving(free_running, address)
    writer.send([make_chunk(10)], 0)
    until(lambda: writer.acknowledged == 10, lambda: first.serve(0.01), lambda: writer.poll(0.0))
    first.close()
    writer.send([make_chunk(10)], 0)
    second = serving(free_running, address)
    try:
        until(lambda: not writer.unacknowledged, lambda: second.serve(0.01), lambda: writer.poll(0.01))
        assert second.metrics()["replay.inserted"] == 10
    finally:
        second.close()


def test_every_transition_is_accounted_for_under_random_disconnects(
    free_running: Config, address: str, make_chunk: MakeChunk, until: Until, generator: np.random.Generator
) -> None:
    small = msgspec.structs.replace(free_running, replay=msgspec.structs.replace(free_running.replay, capacity=300))
    server = serving(small, address)
    writers = [ReplayWriter(address, f"actor{i}", 4, resend_s=0.02) for i in range(3)]
    sent = spoilt = breaks = received = 0

    def turn() -> None:
        nonlocal sent, spoilt, breaks, received
        writer = writers[generator.integers(3)]
        if writer.has_room:
            chunk = make_chunk(int(generator.integers(1, 12)))
            if generator.random() < 0.1:
                chunk.rewards[0] = np.inf
                spoilt += len(chunk.starts)
            writer.send([chunk], 0)
            sent += len(chunk.starts)
        arrived = int(server.metrics()["replay.received"])
        if arrived > received and generator.random() < 0.1:  # all connections break, with whatever is in them
            server._listener.close()
            server._listener = Listener(zmq.ROUTER, address, options={zmq.ROUTER_MANDATORY: 1})
            breaks, received = breaks + 1, arrived
        writer.poll(0.0)
        server.serve(0.001)

    try:
        until(lambda: breaks >= 5 and spoilt >= 10 and sent >= 200, turn)
        for writer in writers:
            until(lambda w=writer: not w.unacknowledged, lambda: server.serve(0.005), lambda w=writer: w.poll(0.0))
        figures = server.metrics()
        assert figures["replay.received"] == sent
        assert sent == figures["replay.size"] + figures["replay.evicted"] + figures["replay.refused"]
        assert figures["replay.refused"] == spoilt > 0
        assert sum(w.resent for w in writers) > 0
    finally:
        for writer in writers:
            writer.close()
        server.close()


def test_a_replaced_actor_learns_it_and_ends(
    free_running: Config, address: str, writer: ReplayWriter, make_chunk: MakeChunk, until: Until
) -> None:
    server = serving(free_running, address)
    newer = ReplayWriter(address, "a", 4)
    try:
        for one in (writer, newer):
            one.send([make_chunk(10)], 0)
            until(lambda one=one: one.acknowledged == 10, lambda: server.serve(0.01), lambda one=one: one.poll(0.0))
        writer.send([make_chunk(10)], 0)
        with pytest.raises(TransportError, match="has taken its place"):
            until(lambda: False, lambda: server.serve(0.01), lambda: writer.poll(0.0))
    finally:
        newer.close()
        server.close()


def test_chunks_of_many_bats_travel_together_with_their_learner_step(
    free_running: Config, address: str, writer: ReplayWriter, make_chunk: MakeChunk
) -> None:
    server = serving(free_running, address)
    try:
        writer.send([make_chunk(10, 0), make_chunk(5), make_chunk(8)], learner_step=44)
        until_s = [writer.flush(0.0)]
        while not until_s[-1]:
            server.serve(0.01)
            until_s.append(writer.flush(0.01))
        sampled = server.store.buffer.sample(50, 0.4, np.random.default_rng(0))
        assert set(sampled.learner_steps) == {44}
        assert server.metrics()["replay.inserted"] == 23
    finally:
        server.close()


def test_flush_tells_when_nobody_answers(writer: ReplayWriter, make_chunk: MakeChunk) -> None:
    writer.send([make_chunk(10)], 0)
    assert not writer.flush(0.02)
    assert writer.unacknowledged == 1


def test_bytes_that_are_no_message_are_counted(make_chunk: MakeChunk, until: Until) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    router = context.socket(zmq.ROUTER)
    port = router.bind_to_random_port("tcp://127.0.0.1")
    writer = ReplayWriter(f"tcp://127.0.0.1:{port}", "a", 4)
    try:
        writer.send([make_chunk(10)], 0)
        until(lambda: router.poll(10), lambda: writer.poll(0.0))
        router.send_multipart([router.recv_multipart()[0], b"nonsense"])
        until(lambda: writer.counters()["writer.refused_messages"] == 1, lambda: writer.poll(0.01))
    finally:
        writer.close()
        context.destroy(linger=0)


def test_what_a_server_said_before_it_fell_silent_is_no_longer_the_reason(
    config: Config, address: str, make_chunk: MakeChunk, until: Until
) -> None:
    now_s = [0.0]
    writer = ReplayWriter(address, "a", window_chunks=4, resend_s=2.0, clock=lambda: now_s[0])
    server = serving(config, address)
    try:

        def held_back() -> bool:
            server.serve(0.01)
            if writer.has_room:
                writer.send([make_chunk(10)], 0)
            writer.poll(0.01)
            return "actors wait for the learner" in writer.waiting

        until(held_back)
        now_s[0] += 2.5
        writer.poll(0.0)
        assert writer.waiting == ""
    finally:
        server.close()
        writer.close()


def test_what_is_unacknowledged_goes_to_the_server_at_another_address(
    free_running: Config, tmp_path: Path, address: str, make_chunk: MakeChunk, until: Until
) -> None:
    writer = ReplayWriter(address, "a", window_chunks=4, generation=1, resend_s=1000.0)
    successor = ReplayServer(free_running, f"ipc://{tmp_path}/s", np.random.default_rng(0), generation=2)
    try:
        writer.send([make_chunk(10)], 0)
        writer.send([make_chunk(10)], 0)
        writer.redirect(successor.address, 2)
        until(lambda: not writer.unacknowledged, lambda: writer.poll(0.0), lambda: successor.serve(0.01))
        assert successor.metrics()["replay.inserted"] == 20
        assert not successor.metrics()["replay.refused_messages"]
    finally:
        writer.close()
        successor.close()
