"""The server through its socket, driven in this thread; hostile bytes come from a bare socket."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from apex_bat.config.settings import Config
from apex_bat.experience import Chunk
from apex_bat.replay.adjusting import change_ratio
from apex_bat.replay.client import ReplayReader, ReplayWriter
from apex_bat.replay.metrics import METRICS, READER_METRICS, WRITER_METRICS, declared_name
from apex_bat.replay.server import ReplayServer
from apex_bat.replay.snapshot import SnapshotError, read_snapshot
from apex_bat.replay.store import ReplayStore
from apex_bat.transport.messages import (
    Ack,
    Insert,
    Message,
    PriorityUpdate,
    RatioChange,
    Report,
    Sample,
    SampleRequest,
    Waiting,
    decode,
    encode,
)
from apex_bat.transport.security import TransportError

MakeChunk = Callable[..., Chunk]
Until = Callable[..., None]


@contextmanager
def serving(server: ReplayServer) -> Iterator[None]:
    """Serves in a thread while the block lasts."""
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            server.serve(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


class Peer:
    """A bare client."""

    def __init__(self, address: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.connect(address)
        self.got: list[Message] = []

    def send(self, *messages: Message | bytes) -> None:
        for message in messages:
            self._socket.send(message if isinstance(message, bytes) else encode(message))

    def receive(self) -> None:
        while self._socket.poll(0):
            self.got.append(decode(self._socket.recv()))

    def close(self) -> None:
        self._context.destroy(linger=0)


@pytest.fixture
def server(config: Config, tmp_path: Path) -> Iterator[ReplayServer]:
    one = ReplayServer(config, "tcp://127.0.0.1:0", np.random.default_rng(0), tmp_path / "replay")
    yield one
    one.close()


@pytest.fixture
def peer(server: ReplayServer) -> Iterator[Peer]:
    one = Peer(server.address)
    yield one
    one.close()


def insert(make_chunk: MakeChunk, sequence: int, actor: str = "a", transitions: int = 10) -> Insert:
    return Insert(actor, 1, sequence, 1, 0, (make_chunk(transitions),))


def test_an_insert_is_acknowledged_and_stored_once_however_often_it_comes(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    message = insert(make_chunk, 1)
    peer.send(message, message, message)
    until(lambda: server.metrics()["replay.duplicates"] == 2, lambda: server.serve(0.01))
    until(lambda: peer.got, peer.receive, lambda: server.serve(0.01))
    assert set(peer.got) == {Ack(1, 1)}
    assert server.metrics()["replay.size"] == 10


def test_a_held_insert_is_not_acknowledged_and_its_actor_is_told_why(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    peer.send(*(insert(make_chunk, sequence, transitions=10) for sequence in range(1, 8)))
    until(lambda: server.metrics()["replay.queued_inserts"] == 4, lambda: server.serve(0.01))
    until(lambda: any(isinstance(m, Waiting) for m in peer.got), lambda: server.serve(0.01), peer.receive)
    # min_size 20, band (4 x 26 + 16) / 2 = 60 samples: balance 4 x (30 - 20) = 40 lets no fourth ten in.
    assert sum(isinstance(m, Ack) for m in peer.got) == 3
    assert "actors wait for the learner" in server.state()
    assert server.metrics()["replay.queued_inserts"] == 4


def test_a_held_actor_is_told_why_although_the_server_never_rests(
    config: Config, make_chunk: MakeChunk, until: Until
) -> None:
    now = [0.0]
    server = ReplayServer(config, "tcp://127.0.0.1:0", np.random.default_rng(0), clock=lambda: now[0])
    actor, learner = Peer(server.address), Peer(server.address)
    try:
        actor.send(*(insert(make_chunk, sequence) for sequence in range(1, 8)))
        until(lambda: server.metrics()["replay.queued_inserts"] == 4, lambda: server.serve(0.01))
        now[0] = 30.0  # the notice due at the start may have gone before the actor was connected
        until(lambda: any(isinstance(m, Waiting) for m in actor.got), lambda: server.serve(0.01), actor.receive)
        actor.got.clear()
        learner.send(SampleRequest(1, 16, 0))
        now[0] = 60.0  # a notice is due, and the next time that the server looks up it answers the learner
        until(lambda: server.metrics()["replay.sampled"] == 16, lambda: server.serve(0.01))
        until(lambda: any(isinstance(m, Waiting) for m in actor.got), actor.receive)
    finally:
        actor.close()
        learner.close()
        server.close()


def test_sampling_lets_held_inserts_in(server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until) -> None:
    peer.send(*(insert(make_chunk, sequence) for sequence in range(1, 8)))
    peer.send(*(SampleRequest(request, 16, 0) for request in range(20)))
    until(lambda: sum(isinstance(m, Ack) for m in peer.got) == 7, lambda: server.serve(0.01), peer.receive)
    assert server.metrics()["replay.samples_per_insert"] == pytest.approx(4.0, abs=60 / 50)


def test_a_request_waits_for_the_first_transitions_and_is_answered_once(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    request = SampleRequest(5, 16, 0)
    peer.send(request, request)
    until(lambda: peer.got, lambda: server.serve(0.01), peer.receive)
    assert isinstance(peer.got[0], Waiting)
    assert "20 transitions are missing" in peer.got[0].reason
    peer.send(insert(make_chunk, 1, transitions=20))
    until(lambda: any(isinstance(m, Sample) for m in peer.got), lambda: server.serve(0.01), peer.receive)
    server.serve(0.01)
    peer.receive()
    samples = [m for m in peer.got if isinstance(m, Sample)]
    assert [sample.request for sample in samples] == [5]


def test_a_non_finite_insert_is_refused_by_name_and_its_actor_goes_on(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until, caplog: pytest.LogCaptureFixture
) -> None:
    bad = insert(make_chunk, 1, "mad actor")
    bad.chunks[0].rewards[3] = np.nan
    peer.send(bad, insert(make_chunk, 2, "mad actor"))
    until(lambda: len(peer.got) == 2, lambda: server.serve(0.01), peer.receive)
    refused, stored = peer.got
    assert isinstance(refused, Ack)
    assert "finite" in refused.refused
    assert stored == Ack(1, 2)
    assert server.refusals == {"value": 1}
    assert server.metrics()["replay.refused"] == 10
    assert "mad actor" in caplog.text


def test_bad_bytes_are_counted_by_reason_and_disturb_nobody(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    good = bytes(encode(insert(make_chunk, 1)))
    wrong_version = good[:4] + b"\x09\x00" + good[6:]
    peer.send(
        b"", b"\x80\x04pickle", good[:-8], good + bytes(8), wrong_version, bytes(encode(insert(make_chunk, 1), 7))
    )
    peer.send(Report("actor", 1, "h", "a", "s", {}))
    peer.send(good)
    until(lambda: peer.got, lambda: server.serve(0.01), peer.receive)
    assert peer.got == [Ack(1, 1)]
    assert server.refusals == {"size": 4, "protocol": 1, "generation": 1, "unexpected": 1}


def test_a_message_beyond_the_limit_is_dropped_by_the_socket(
    config: Config, make_chunk: MakeChunk, until: Until
) -> None:
    small = msgspec.structs.replace(config, transport=msgspec.structs.replace(config.transport, max_message_mb=0.01))
    server = ReplayServer(small, "tcp://127.0.0.1:0", np.random.default_rng(0))
    large, good = Peer(server.address), Peer(server.address)
    try:
        large.send(insert(make_chunk, 1, "large", transitions=100))
        good.send(insert(make_chunk, 1))
        until(lambda: good.got, lambda: server.serve(0.01), good.receive)
        assert set(server.store.actor_shares()) == {"a"}
    finally:
        large.close()
        good.close()
        server.close()


def test_late_and_repeated_priorities_are_harmless(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    peer.send(insert(make_chunk, 1))
    until(lambda: peer.got, lambda: server.serve(0.01), peer.receive)
    late = PriorityUpdate(4, np.array([3, 999]), np.array([1.0, 1.0], np.float32))
    peer.send(late, late)
    until(lambda: server.metrics()["replay.late_priorities"] == 2, lambda: server.serve(0.01))
    assert server.store.learner_step == 4


def test_answers_to_the_gone_are_counted_and_not_as_samples(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    gone = Peer(server.address)
    gone.send(SampleRequest(1, 16, 0))
    until(lambda: server.metrics()["replay.queued_requests"], lambda: server.serve(0.01))
    gone.close()
    peer.send(insert(make_chunk, 1), insert(make_chunk, 2))
    until(lambda: server.metrics()["replay.undelivered"], lambda: server.serve(0.01))
    assert server.metrics()["replay.sampled"] == 0


def test_a_restored_server_recognises_what_was_stored_and_draws_on(
    server: ReplayServer, peer: Peer, config: Config, make_chunk: MakeChunk, until: Until, tmp_path: Path
) -> None:
    messages = [insert(make_chunk, 1), insert(make_chunk, 2)]
    peer.send(*messages, SampleRequest(1, 16, 9))
    until(lambda: any(isinstance(m, Sample) for m in peer.got), lambda: server.serve(0.01), peer.receive)
    server.save()
    restored = ReplayServer(config, "tcp://127.0.0.1:0", np.random.default_rng(99), tmp_path / "replay")
    other = Peer(restored.address)
    try:
        assert "20 transitions" in restored.restore()
        ours = {name: figure for name, figure in restored.metrics().items() if not name.endswith("_s")}
        assert ours == {name: figure for name, figure in server.metrics().items() if not name.endswith("_s")}
        other.send(*messages)
        until(lambda: len(other.got) == 2, lambda: restored.serve(0.01), other.receive)
        assert restored.metrics()["replay.size"] == 20
        np.testing.assert_equal(server.store.sample(16, 9), restored.store.sample(16, 9))
    finally:
        other.close()
        restored.close()


def test_snapshots_are_made_while_serving_and_a_failed_one_is_told(
    config: Config, tmp_path: Path, until: Until
) -> None:
    now = [0.0]
    often = msgspec.structs.replace(config, replay=msgspec.structs.replace(config.replay, snapshot_period_s=60.0))
    folder = tmp_path / "snapshots"
    folder.mkdir()
    server = ReplayServer(often, "tcp://127.0.0.1:0", np.random.default_rng(0), folder / "replay", clock=lambda: now[0])
    try:
        server.serve(0.0)
        assert not list(folder.iterdir())
        now[0] = 61.0
        until(lambda: server.metrics()["replay.snapshots"] == 1, lambda: server.serve(0.01))
        assert (folder / "replay").exists()
        (folder / "replay").unlink()
        folder.rmdir()
        now[0] = 122.0
        until(lambda: server.metrics()["replay.failed_snapshots"] == 1, lambda: server.serve(0.01))
    finally:
        server.close()


def test_a_ratio_changed_from_outside_holds_at_once(server: ReplayServer) -> None:
    with serving(server):
        now = change_ratio(server.address, RatioChange(2.0))
    assert server.store.limiter.law == (2.0, now.error_buffer)
    assert server.metrics()["replay.wanted_samples_per_insert"] == 2.0


def test_a_ratio_that_could_lead_to_a_standstill_is_refused_with_the_reason(server: ReplayServer) -> None:
    law = server.store.limiter.law
    with serving(server), pytest.raises(ValueError, match="wait for each other for ever"):
        change_ratio(server.address, RatioChange(2.0, error_buffer=1.0))
    assert server.store.limiter.law == law


def test_a_ratio_is_not_changed_where_nobody_keeps_it(config: Config) -> None:
    replay = msgspec.structs.replace(config.replay, never_block=True)
    server = ReplayServer(msgspec.structs.replace(config, replay=replay), "tcp://127.0.0.1:0", np.random.default_rng(0))
    try:
        with serving(server), pytest.raises(ValueError, match="never_block"):
            change_ratio(server.address, RatioChange(2.0))
    finally:
        server.close()


def test_a_changed_ratio_is_in_a_snapshot_at_once_also_where_none_are_periodic(config: Config, tmp_path: Path) -> None:
    path = tmp_path / "snapshot"
    server = ReplayServer(config, "tcp://127.0.0.1:0", np.random.default_rng(0), path)
    try:
        with serving(server):
            change_ratio(server.address, RatioChange(2.0))
            ends_s = time.monotonic() + 20.0
            while not path.exists():
                assert time.monotonic() < ends_s
                time.sleep(0.01)
    finally:
        server.close()
    state, _ = read_snapshot(path, ReplayStore(config, np.random.default_rng(0)).buffer)
    assert state["law"][0] == 2.0


def test_an_insert_that_could_never_be_let_in_is_refused_and_stops_nobody(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    peer.send(insert(make_chunk, 1, transitions=60), insert(make_chunk, 2, transitions=10))
    until(lambda: sum(isinstance(m, Ack) for m in peer.got) == 2, lambda: server.serve(0.01), peer.receive)
    refused, stored = (m for m in peer.got if isinstance(m, Ack))
    assert "60 transitions at once" in refused.refused
    assert not stored.refused
    assert server.metrics()["replay.refused"] == 60


def test_nobody_who_does_not_know_the_generation_changes_the_ratio(server: ReplayServer) -> None:
    law = server.store.limiter.law
    with serving(server), pytest.raises(TransportError, match="no answer"):
        change_ratio(server.address, RatioChange(2.0), generation=7, timeout_s=0.1)
    assert server.store.limiter.law == law


def test_each_metric_is_declared(server: ReplayServer, make_chunk: MakeChunk) -> None:
    server.store.add("a", 0, [make_chunk(10)])
    assert {declared_name(name) for name in server.metrics()} == set(METRICS)
    writer, reader = ReplayWriter(server.address, "a", 8), ReplayReader(server.address, 16, 2)
    try:
        assert set(writer.counters()) == set(WRITER_METRICS)
        assert set(reader.counters()) == set(READER_METRICS)
    finally:
        writer.close()
        reader.close()


def test_a_request_for_another_batch_than_the_settings_give_is_refused(
    server: ReplayServer, peer: Peer, make_chunk: MakeChunk, until: Until
) -> None:
    peer.send(insert(make_chunk, 1), insert(make_chunk, 2), SampleRequest(1, 65_536, 2**61))
    until(lambda: server.refusals.get("batch_size"), lambda: server.serve(0.01))
    assert server.metrics()["replay.queued_requests"] == 0
    assert server.store.learner_step == 0, "and what it says of the learner is not believed"


def test_more_or_fewer_parts_than_one_are_refused(server: ReplayServer, make_chunk: MakeChunk, until: Until) -> None:
    good = bytes(encode(insert(make_chunk, 1)))
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        for kind, parts in ((zmq.DEALER, [good, good]), (zmq.REQ, [good])):
            socket = context.socket(kind)
            socket.connect(server.address)
            socket.send_multipart(parts)
        until(lambda: server.refusals.get("parts") == 2, lambda: server.serve(0.01))
        assert server.metrics()["replay.size"] == 0
    finally:
        context.destroy(linger=0)


@pytest.mark.parametrize(
    "lie", [{"sequences": 3}, {"counts": {}}, {"limiter": [1]}, {"actors": None}, {"generator": {}}]
)
def test_a_snapshot_with_a_state_that_lies_is_refused(
    server: ReplayServer, config: Config, lie: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = server._state()
    monkeypatch.setattr(server, "_state", lambda: state | lie)
    server.save()
    other = ReplayServer(config, "tcp://127.0.0.1:0", np.random.default_rng(0), tmp_path / "replay")
    try:
        with pytest.raises(SnapshotError):
            other.restore()
    finally:
        other.close()


def test_a_priority_for_an_item_that_was_lost_with_an_earlier_life_lands_on_no_other(
    config: Config, tmp_path: Path, make_chunk: MakeChunk
) -> None:
    def life(number: int) -> ReplayServer:
        generator = np.random.default_rng(number)
        return ReplayServer(config, "tcp://127.0.0.1:0", generator, tmp_path / "replay", life=number)

    with closing(life(3)) as first:
        first.store.add("a", 0, [make_chunk(20)])
        first.save()
        first.store.add("a", 0, [make_chunk(20)])
        known = first.store.sample(40, 0).items
    with closing(life(4)) as second:
        assert "20 transitions" in second.restore()
        second.store.add("a", 0, [make_chunk(20)])
        before = second.store.buffer.some_priorities(40)
        second.store.update(1, known, np.full(40, 9.0, np.float32))
        np.testing.assert_array_equal(second.store.buffer.some_priorities(40), before)
        assert second.metrics()["replay.late_priorities"] == 40
        own = second.store.sample(40, 1).items
        second.store.update(1, own, np.full(40, 9.0, np.float32))
        assert second.metrics()["replay.late_priorities"] == 40
        assert second.metrics()["replay.updated_priorities"] == 40
