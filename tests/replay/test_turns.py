"""An actor's end of several servers: in turn, and past one that is away."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import msgspec
import numpy as np
import pytest

from apex_bat.config.settings import Config
from apex_bat.experience import Chunk
from apex_bat.replay.client import TurnWriter
from apex_bat.replay.metrics import WRITER_METRICS
from apex_bat.replay.server import ReplayServer

MakeChunk = Callable[..., Chunk]
Until = Callable[..., None]


@pytest.fixture
def free_running(config: Config) -> Config:
    replay = msgspec.structs.replace(config.replay, never_block=True, shards=2)
    return msgspec.structs.replace(config, replay=replay)


@pytest.fixture
def servers(free_running: Config) -> Iterator[list[ReplayServer]]:
    with ExitStack() as stack:
        yield [
            stack.enter_context(
                closing(ReplayServer(free_running, "tcp://127.0.0.1:0", np.random.default_rng(i), generation=40 + i))
            )
            for i in range(2)
        ]


@pytest.fixture
def writer(servers: list[ReplayServer]) -> Iterator[TurnWriter]:
    one = TurnWriter([server.address for server in servers], "a", 8, first=1, generation=[40, 41])
    yield one
    one.close()


def served(servers: list[ReplayServer]) -> Callable[[], None]:
    def serve() -> None:
        for server in servers:
            server.serve(0.01)

    return serve


def test_inserts_go_to_the_servers_in_turn_from_the_first_that_it_was_told(
    servers: list[ReplayServer], writer: TurnWriter, make_chunk: MakeChunk, until: Until
) -> None:
    for _ in range(5):
        until(lambda: writer.has_room, served(servers), lambda: writer.poll(0.0))
        writer.send([make_chunk(10)], 0)
        until(lambda: not writer.unacknowledged, served(servers), lambda: writer.poll(0.01))
    assert [server.store.limiter.inserted for server in servers] == [20, 30]
    assert set(writer.counters()) == set(WRITER_METRICS)
    assert writer.counters()["writer.acknowledged"] == 50


def test_a_server_that_is_away_is_passed_by_and_gets_its_inserts_when_it_is_back(
    servers: list[ReplayServer], writer: TurnWriter, free_running: Config, make_chunk: MakeChunk, until: Until
) -> None:
    address = servers[0].address
    servers[0].close()
    for _ in range(12):
        until(lambda: writer.has_room, lambda: servers[1].serve(0.01), lambda: writer.poll(0.0))
        writer.send([make_chunk(10)], 0)
    until(lambda: servers[1].store.limiter.inserted == 80, lambda: servers[1].serve(0.01), lambda: writer.poll(0.0))
    assert writer.has_room, "four chunks wait for the other, and that is all that can"
    servers[0] = ReplayServer(free_running, address, np.random.default_rng(0), generation=40)
    try:
        until(lambda: not writer.unacknowledged, served(servers), lambda: writer.poll(0.01))
        assert [server.store.limiter.inserted for server in servers] == [40, 80]
    finally:
        servers[0].close()


def test_without_room_anywhere_it_says_so(servers: list[ReplayServer], make_chunk: MakeChunk) -> None:
    with closing(TurnWriter([server.address for server in servers], "a", 4, generation=[40, 41])) as writer:
        for _ in range(4):
            writer.send([make_chunk(10)], 0)
        assert not writer.has_room
        with pytest.raises(ValueError, match="the window is full"):
            writer.send([make_chunk(10)], 0)
        assert not writer.flush(0.05)


def test_it_goes_where_the_servers_go(
    servers: list[ReplayServer], writer: TurnWriter, free_running: Config, make_chunk: MakeChunk, until: Until
) -> None:
    successor = ReplayServer(free_running, "tcp://127.0.0.1:0", np.random.default_rng(3), generation=50)
    try:
        writer.redirect([servers[0].address, successor.address], [40, 50])
        writer.send([make_chunk(10)], 0)
        until(lambda: successor.store.limiter.inserted == 10, lambda: successor.serve(0.01), lambda: writer.poll(0.0))
    finally:
        successor.close()
