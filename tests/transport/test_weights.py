"""Weights: the newest wins, the late get them at once, and others' are refused."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import zmq
from numpy.typing import NDArray

from apex_bat.transport.messages import Weights
from apex_bat.transport.security import make_keys
from apex_bat.transport.sockets import Connection
from apex_bat.transport.weights import MAX_NOTICE_BYTES, REPEAT_S, WeightsPublisher, WeightsSubscriber

SHAPES: dict[str, tuple[int, ...]] = {"w": (3, 4), "b": (4,)}


def arrays(value: float, **more: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    return {name: np.full(shape, value, np.float32) for name, shape in SHAPES.items()} | more


@pytest.fixture
def publisher() -> Iterator[WeightsPublisher]:
    one = WeightsPublisher("tcp://127.0.0.1:0")
    yield one
    one.close()


@pytest.fixture
def subscriber(publisher: WeightsPublisher) -> Iterator[WeightsSubscriber]:
    one = WeightsSubscriber(publisher.address, SHAPES)
    yield one
    one.close()


def arrival(publisher: WeightsPublisher, subscriber: WeightsSubscriber) -> Weights:
    """Returns the next weights that arrive, while the publisher is served."""
    ends_s = time.monotonic() + 10
    while time.monotonic() < ends_s:
        publisher.serve()
        subscriber.wait(0.01)
        if (weights := subscriber.newest()) is not None:
            return weights
    raise AssertionError("no weights came")


def test_a_late_subscriber_gets_the_newest_at_once(publisher: WeightsPublisher) -> None:
    for version in range(3):
        publisher.publish(version, version * 25, arrays(version))
    for _ in range(2):
        late = WeightsSubscriber(publisher.address, SHAPES)
        try:
            weights = arrival(publisher, late)
            assert (weights.version, weights.learner_step) == (2, 50)
            np.testing.assert_equal(weights.arrays, arrays(2))
            assert late.newest() is None
        finally:
            late.close()


def test_a_slow_subscriber_finds_the_newest_even_if_a_full_queue_dropped_it() -> None:
    now = [0.0]
    publisher = WeightsPublisher("tcp://127.0.0.1:0", clock=lambda: now[0])
    subscriber = WeightsSubscriber(publisher.address)
    try:
        publisher.publish(0, 0, arrays(0))
        arrival(publisher, subscriber)
        for version in range(1, 100):  # faster than any queue is emptied
            publisher.publish(version, version, arrays(version))
        now[0] = REPEAT_S
        seen = [arrival(publisher, subscriber).version]
        while seen[-1] < 99:
            now[0] += REPEAT_S
            seen.append(arrival(publisher, subscriber).version)
        assert len(seen) < 99
        assert seen == sorted(seen)
    finally:
        subscriber.close()
        publisher.close()


def test_weights_sent_again_for_somebody_else_are_not_new(
    publisher: WeightsPublisher, subscriber: WeightsSubscriber
) -> None:
    publisher.publish(1, 1, arrays(1))
    arrival(publisher, subscriber)
    other = WeightsSubscriber(publisher.address)
    try:
        arrival(publisher, other)
        subscriber.wait(1.0)
        assert subscriber.newest() is None
    finally:
        other.close()


def test_a_learner_resumed_at_a_lower_version_is_followed(
    publisher: WeightsPublisher, subscriber: WeightsSubscriber
) -> None:
    publisher.publish(7, 700, arrays(7))
    arrival(publisher, subscriber)
    publisher.publish(5, 500, arrays(5))
    assert arrival(publisher, subscriber).version == 5


@pytest.mark.parametrize(
    "wrong",
    [
        {"w": np.zeros((3, 4), np.float32)},
        arrays(0, extra=np.zeros(1, np.float32)),
        {"w": np.zeros((4, 3), np.float32), "b": np.zeros(4, np.float32)},
        arrays(np.nan),
    ],
)
def test_weights_of_another_network_are_refused_and_counted(
    publisher: WeightsPublisher, subscriber: WeightsSubscriber, wrong: dict[str, NDArray[np.float32]]
) -> None:
    publisher.publish(1, 1, wrong)
    ends_s = time.monotonic() + 10
    while not subscriber.refusals.total:
        assert time.monotonic() < ends_s
        publisher.serve()
        subscriber.wait(0.01)
        assert subscriber.newest() is None
    publisher.publish(2, 2, arrays(2))
    assert arrival(publisher, subscriber).version == 2


def test_weights_of_another_generation_are_refused(publisher: WeightsPublisher) -> None:
    other = WeightsSubscriber(publisher.address, generation=3)
    try:
        publisher.publish(1, 1, arrays(1))
        ends_s = time.monotonic() + 10
        while other.refusals.counts != {"generation": 1}:
            assert time.monotonic() < ends_s
            publisher.serve()
            other.wait(0.01)
            other.newest()
    finally:
        other.close()


def test_arrays_in_any_memory_order_arrive_as_they_are(publisher: WeightsPublisher) -> None:
    turned = np.arange(12, dtype=np.float32).reshape(4, 3).T
    publisher.publish(1, 1, {"w": turned, "b": np.zeros(4, np.float32)})
    late = WeightsSubscriber(publisher.address, SHAPES)
    try:
        np.testing.assert_array_equal(arrival(publisher, late).arrays["w"], turned)
    finally:
        late.close()


def test_weights_travel_encrypted_to_those_with_keys(tmp_path: Path) -> None:
    keys = make_keys(tmp_path / "keys")
    publisher = WeightsPublisher("tcp://127.0.0.1:0", keys=keys)
    friend, stranger = WeightsSubscriber(publisher.address, keys=keys), WeightsSubscriber(publisher.address)
    try:
        publisher.publish(1, 1, arrays(1))
        assert arrival(publisher, friend).version == 1
        assert not stranger.wait(0.05)
    finally:
        friend.close()
        stranger.close()
        publisher.close()


def test_strange_subscriptions_are_counted_and_forgotten_and_disturb_nobody(
    publisher: WeightsPublisher, subscriber: WeightsSubscriber, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("apex_bat.transport.weights.MAX_STRANGE", 3)
    publisher.publish(1, 1, arrays(1))
    assert arrival(publisher, subscriber).version == 1
    address = publisher.address
    stranger = Connection(zmq.XSUB, address)
    try:
        for topic in range(10):
            stranger.socket.send(b"\x01topic%d" % topic)
        stranger.socket.send(b"\x00topic")
        ends_s = time.monotonic() + 10
        while publisher.refusals.counts.get("subscription", 0) < 4 or "unexpected" not in publisher.refusals.counts:
            assert time.monotonic() < ends_s
            with suppress(zmq.Again):  # again and again: what is under way when the socket is opened anew is lost
                stranger.socket.send(b"a message", zmq.NOBLOCK)
            publisher.serve()
        publisher.publish(2, 2, arrays(2))
        assert arrival(publisher, subscriber).version == 2  # by a connection made anew, if it has to be
        assert publisher.address == address
        assert publisher._num_strange <= 7, "of ten; those before the socket was opened anew are forgotten"
    finally:
        stranger.close()


def test_who_subscribes_all_the_time_does_not_multiply_the_broadcasts() -> None:
    now = [0.0]
    publisher = WeightsPublisher("tcp://127.0.0.1:0", clock=lambda: now[0])
    subscriber = Connection(zmq.SUB, publisher.address)  # one that keeps all that comes
    subscriber.socket.setsockopt(zmq.SUBSCRIBE, b"")
    stranger = Connection(zmq.XSUB, publisher.address)
    try:
        ends_s = time.monotonic() + 10
        publisher.publish(1, 1, arrays(1))
        while not subscriber.socket.poll(10):
            assert time.monotonic() < ends_s
            publisher.serve()
        for _ in range(50):
            stranger.socket.send(b"\x01")
        stranger.socket.send(b"the last")  # counted when all before it have been seen
        while not publisher.refusals.total:
            assert time.monotonic() < ends_s
            publisher.serve()
        received = 0
        while subscriber.socket.poll(50):
            subscriber.socket.recv()
            received += 1
        assert received <= 2  # the clock stands: one for all who subscribed, beside the first
    finally:
        stranger.close()
        subscriber.close()
        publisher.close()


def test_a_large_subscription_ends_the_connection(publisher: WeightsPublisher) -> None:
    stranger = Connection(zmq.XSUB, publisher.address)
    try:
        stranger.socket.send(b"\x01" + bytes(MAX_NOTICE_BYTES))
        ends_s = time.monotonic() + 10
        while not publisher._listener.num_ended:
            assert time.monotonic() < ends_s
            publisher.serve()
        assert publisher.refusals.total == 0
    finally:
        stranger.close()


def test_a_subscriber_follows_a_publisher_to_another_address_and_generation(
    publisher: WeightsPublisher, subscriber: WeightsSubscriber
) -> None:
    publisher.publish(1, 25, arrays(1))
    assert arrival(publisher, subscriber).version == 1
    successor = WeightsPublisher("tcp://127.0.0.1:0", generation=7)
    try:
        successor.publish(2, 50, arrays(2))
        subscriber.redirect(successor.address, 7)
        assert arrival(successor, subscriber).version == 2
        publisher.publish(3, 75, arrays(3))  # what the former one still says is not heard
        successor.publish(4, 100, arrays(4))
        assert arrival(successor, subscriber).version == 4
    finally:
        successor.close()
