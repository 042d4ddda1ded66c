"""The learner's end: what it is given, what it gives back, and what it says while it waits."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from apex_bat.config.settings import Config
from apex_bat.experience import Batch, Chunk
from apex_bat.replay.client import ReplayReader, ReplayWriter
from apex_bat.replay.server import ReplayServer

MakeChunk = Callable[..., Chunk]
Until = Callable[..., None]


@pytest.fixture
def free_running(config: Config) -> Config:
    """Settings in which nobody waits, and priorities count as they are."""
    replay = msgspec.structs.replace(config.replay, never_block=True, alpha=1.0, priority_epsilon=1e-6)
    return msgspec.structs.replace(config, replay=replay)


@pytest.fixture
def address(tmp_path: Path) -> str:
    tmp_path.chmod(0o700)
    return f"ipc://{tmp_path}/r"


@pytest.fixture
def server(free_running: Config, address: str) -> Iterator[ReplayServer]:
    one = ReplayServer(free_running, address, np.random.default_rng(0))
    yield one
    one.close()


@pytest.fixture
def reader(address: str) -> Iterator[ReplayReader]:
    one = ReplayReader(address, batch_size=16, prefetch=3, ask_again_s=0.1)
    yield one
    one.close()


def batches(server: ReplayServer, reader: ReplayReader, num: int) -> list[Batch]:
    """Returns the next batches, while the server is served from here."""
    got: list[Batch] = []
    for _ in range(20_000):
        server.serve(0.0)
        if (batch := reader.next(0.001)) is not None:
            got.append(batch)
        if len(got) == num:
            return got
    raise AssertionError(f"only {len(got)} of {num} batches came; {reader.waiting}")


def test_frequencies_follow_priorities_through_the_whole_wire(
    server: ReplayServer, reader: ReplayReader, address: str, make_chunk: MakeChunk, until: Until
) -> None:
    writer = ReplayWriter(address, "a", 8)
    chunk = make_chunk(40)
    writer.send([chunk], 0)
    until(lambda: not writer.unacknowledged, lambda: server.serve(0.01), lambda: writer.poll(0.0))
    writer.close()
    batches(server, reader, 3)
    changed = np.linspace(0.5, 4.0, 20, dtype=np.float32)
    reader.update(np.arange(20), changed)
    until(lambda: server.store.learner_step == 1, lambda: server.serve(0.01))
    batches(server, reader, 6)  # those drawn before the update
    drawn = np.concatenate([batch.items for batch in batches(server, reader, 300)])
    wanted = np.concatenate([changed, chunk.priorities[20:]]).astype(np.float64) + 1e-6
    expected = wanted / wanted.sum() * len(drawn)
    chi_square = ((np.bincount(drawn, minlength=40) - expected) ** 2 / expected).sum()
    assert chi_square < 73  # 0.1 % of 39 degrees of freedom; stratified draws lie below a chi-square


def test_batches_are_asked_for_ahead_and_no_further(
    server: ReplayServer, reader: ReplayReader, make_chunk: MakeChunk, until: Until
) -> None:
    server.store.add("a", 0, [make_chunk(40)])
    until(lambda: reader.counters()["reader.ready"] == 3, lambda: server.serve(0.01))
    server.serve(0.05)
    assert reader.counters()["reader.received"] == 3
    assert reader.next(0.0) is not None
    until(lambda: reader.counters()["reader.received"] == 4, lambda: server.serve(0.01))


def test_arrays_of_a_batch_can_be_written_to_and_are_complete(
    server: ReplayServer, reader: ReplayReader, make_chunk: MakeChunk
) -> None:
    server.store.add("a", 0, [make_chunk(40)])
    batch = batches(server, reader, 1)[0]
    assert batch.states.echoes.shape == batch.next_states.echoes.shape == (16, 6, 24)
    assert batch.states.actions.shape == (16, 3)
    assert batch.states.echoes.flags.writeable
    assert (batch.states.echoes != 0).all()


def test_each_update_counts_one_learner_step(
    server: ReplayServer, address: str, make_chunk: MakeChunk, until: Until
) -> None:
    server.store.add("a", 0, [make_chunk(40)])
    reader = ReplayReader(address, 16, 2, learner_step=100)
    try:
        for _ in range(3):
            reader.update(np.array([1]), np.array([0.5], np.float32))
        until(lambda: server.store.learner_step == 103, lambda: server.serve(0.01))
    finally:
        reader.close()


def test_it_says_what_the_server_waits_for_and_when_there_is_no_server(
    server: ReplayServer, reader: ReplayReader, until: Until
) -> None:
    until(lambda: "20 transitions are missing" in reader.waiting, lambda: server.serve(0.01))
    assert reader.next(0.0) is None
    asked = reader.counters()["reader.asked_again"]
    server.close()
    until(lambda: "no answer from the replay server at ipc" in reader.waiting, lambda: reader.next(0.01))
    until(lambda: reader.counters()["reader.asked_again"] > asked, lambda: reader.next(0.01))
    assert "no answer from the replay server at ipc" in reader.waiting, "asking again is no answer"


def test_it_goes_on_with_the_next_server_at_the_same_address(
    server: ReplayServer, reader: ReplayReader, free_running: Config, address: str, make_chunk: MakeChunk, until: Until
) -> None:
    # The first has nothing to give, and dies with all three requests in its queue.
    until(lambda: server.metrics()["replay.queued_requests"] == 3, lambda: server.serve(0.01))
    server.close()
    second = ReplayServer(free_running, address, np.random.default_rng(1))
    try:
        second.store.add("a", 0, [make_chunk(40)])
        batches(second, reader, 10)
        assert reader.counters()["reader.asked_again"] >= 3
    finally:
        second.close()


def test_several_servers_are_drawn_from_as_one_and_priorities_find_their_way_back(
    free_running: Config, make_chunk: MakeChunk, until: Until
) -> None:
    servers = [
        ReplayServer(free_running, "tcp://127.0.0.1:0", np.random.default_rng(i), generation=7 + i) for i in range(2)
    ]
    priorities = np.zeros(80)
    for number, server in enumerate(servers):
        chunk = make_chunk(40)
        chunk = chunk._replace(priorities=(0.2 + (1 + 4 * number) * chunk.priorities).astype(np.float32))
        server.store.add("a", 0, [chunk])
        priorities[number::2] = chunk.priorities
    addresses, generator = [server.address for server in servers], np.random.default_rng(5)
    reader = ReplayReader(addresses, 16, 4, generation=[7, 8], generator=generator)

    def drawn(number: int) -> list[Batch]:
        got: list[Batch] = []

        def step() -> None:
            for server in servers:
                server.serve(0.0)
            batch = reader.next(0.001)
            got.extend([] if batch is None else [batch])

        until(lambda: len(got) >= number, step)
        return got

    try:
        drawn(6)
        reader.update(np.array([2 * 7 + 1, 2 * 5]), np.array([3.0, 9.0], np.float32))
        priorities[[15, 10]] = 3.0, 9.0
        until(
            lambda: all(server.metrics()["replay.updated_priorities"] for server in servers),
            *(functools.partial(server.serve, 0.001) for server in servers),
        )
        drawn(10)  # those drawn before the update
        items = np.concatenate([batch.items for batch in drawn(500)])
        expected = priorities / priorities.sum() * len(items)
        chi_square = ((np.bincount(items, minlength=80) - expected) ** 2 / expected).sum()
        assert chi_square < 125  # 0.1 % of 79 degrees of freedom; stratified draws lie below a chi-square
        assert reader.counters()["reader.servers_away"] == 0
    finally:
        reader.close()
        for server in servers:
            server.close()


def test_closing_is_quick_without_a_server(address: str) -> None:
    reader = ReplayReader(address, 16, 4)
    reader.update(np.array([1]), np.array([1.0], np.float32))
    reader.close()
    reader.close()


def test_updates_that_wait_go_together_and_the_last_of_an_item_counts(
    server: ReplayServer, reader: ReplayReader, make_chunk: MakeChunk, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.store.add("a", 0, [make_chunk(10)])
    until(lambda: server.metrics()["replay.queued_requests"] == 3, lambda: server.serve(0.01))
    sizes: list[int] = []
    update = server.store.update

    def counted(step: int, items: NDArray[np.int64], errors: NDArray[np.float32]) -> None:
        sizes.append(len(items))
        update(step, items, errors)

    monkeypatch.setattr(server.store, "update", counted)
    for step, priority in enumerate((0.5, 0.25), start=1):
        reader.update(np.array([3, 4 + step]), np.full(2, priority, np.float32))
    until(lambda: server.store.learner_step == 2, lambda: server.serve(0.01))
    assert sizes == [4]
    priorities = server.store.buffer.item_arrays()["items"]["priority"]
    np.testing.assert_allclose(priorities[[3, 5, 6]], [0.25, 0.5, 0.25], rtol=1e-4)


def test_requests_that_were_lost_go_again_although_others_are_answered(
    server: ReplayServer, address: str, make_chunk: MakeChunk, until: Until
) -> None:
    with closing(ReplayReader(address, 16, 8, ask_again_s=60.0)) as reader:
        until(lambda: server.metrics()["replay.queued_requests"] == 8, lambda: server.serve(0.0))
        requests = server._outlet.requests  # lost here stands for lost on the way
        for _ in range(5):
            requests.take()
        server.store.add("a", 0, [make_chunk(40)])
        batches(server, reader, 40)
        assert reader.counters()["reader.asked_again"] == 5


def test_what_ends_the_thread_is_raised_instead_of_waited_for(reader: ReplayReader, until: Until) -> None:
    reader._updates.append((1, np.arange(2), np.zeros(3, np.float32)))
    with pytest.raises(IndexError, match="boolean index"):
        until(lambda: False, lambda: reader.next(0.01))


def test_priorities_that_do_not_fit_their_items_are_refused(reader: ReplayReader) -> None:
    with pytest.raises(ValueError, match="3 priorities for 2 items"):
        reader.update(np.arange(2), np.zeros(3, np.float32))


def test_what_is_outstanding_is_asked_for_at_the_server_at_another_address(
    server: ReplayServer, free_running: Config, tmp_path: Path, address: str, make_chunk: MakeChunk, until: Until
) -> None:
    reader = ReplayReader(address, batch_size=16, prefetch=3, ask_again_s=1000.0)
    successor = ReplayServer(free_running, f"ipc://{tmp_path}/s", np.random.default_rng(1), generation=2)
    try:
        until(lambda: server.metrics()["replay.queued_requests"] == 3, lambda: server.serve(0.01))
        successor.store.add("a", 0, [make_chunk(40)])
        reader.redirect(successor.address, 2)
        batches(successor, reader, 10)
        assert not successor.metrics()["replay.refused_messages"]
    finally:
        reader.close()
        successor.close()
