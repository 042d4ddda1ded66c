"""Messages: what goes in comes out, and nothing else does."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_bat.experience import NO_ACTION, Batch, Chunk, States
from apex_bat.transport.framing import PREFIX
from apex_bat.transport.messages import (
    Ack,
    Insert,
    InsertHeader,
    Message,
    MessageError,
    PartRequest,
    PriorityUpdate,
    Ratio,
    RatioChange,
    Report,
    Sample,
    SampleRequest,
    Standing,
    Subscription,
    Waiting,
    Weights,
    decode,
    encode,
)


def chunk(transitions: int = 4, first_step: int = 9) -> Chunk:
    generator = np.random.default_rng(transitions)
    actions = generator.integers(0, 3, transitions + 6).astype(np.uint8)
    actions[-1] = NO_ACTION
    return Chunk(
        first_step,
        generator.random((transitions + 6, 2, 24), dtype=np.float32),
        actions,
        np.arange(3, transitions + 3, dtype=np.uint16),
        np.full(transitions, 2, np.uint8),
        *(generator.random(transitions, dtype=np.float32) for _ in range(3)),
    )


def batch(size: int = 5) -> Batch:
    generator = np.random.default_rng(0)

    def states() -> States:
        echoes = generator.random((size, 6, 24), dtype=np.float32)
        return States(echoes, generator.integers(0, 3, (size, 3)).astype(np.uint8))

    floats = [generator.random(size, dtype=np.float32) for _ in range(3)]
    actions = generator.integers(0, 3, size).astype(np.uint8)
    return Batch(np.arange(size) + 2**40, floats[0], states(), actions, floats[1], floats[2], states())


def insert(*chunks: Chunk) -> Insert:
    return Insert("actor 3", 2**61, 17, 15, 1200, chunks or (chunk(4), chunk(7, 0), chunk(1)))


MESSAGES: list[Message] = [
    insert(),
    Ack(5, 6, "because"),
    Waiting("for actors"),
    SampleRequest(1, 512, 9),
    Sample(1, batch()),
    PartRequest(3, 0, 64, 9),
    Standing(3, 500, 12.5, 90, 0.4, 1.5, "for actors"),
    Sample(3, batch(), Standing(3, 500, 12.5, 90, 0.4, 1.5)),
    PriorityUpdate(4, np.arange(3), np.array([0.5, -1.0, 2.0], np.float32)),
    RatioChange(2.5),
    Ratio(2.5, 800.0, "because"),
    Weights(3, 75, {"a.weight": np.ones((2, 3), np.float32), "a.bias": np.zeros((), np.float32)}),
    Subscription(-1, 75),
    Report("actor", 77, "host", "ipc:///x", "flying", {"steps_per_s": 1.5}),
]


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_a_message_survives_the_wire(message: Message) -> None:
    np.testing.assert_equal(decode(bytes(encode(message))), message)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_damaged_messages_decode_or_raise_message_error(message: Message, data: st.DataObject) -> None:
    damaged = encode(message)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(damaged) - 1))
        damaged[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.one_of(st.just(len(damaged)), st.integers(0, len(damaged))))
    with contextlib.suppress(MessageError):  # the only exception that may leave
        decode(damaged[:cut])


@settings(max_examples=300, deadline=None)
@given(header=st.binary(max_size=300), body=st.binary(max_size=64))
def test_any_header_and_body_decode_or_raise_message_error(header: bytes, body: bytes) -> None:
    padding = bytes(-(PREFIX.size + len(header)) % 8)
    data = PREFIX.pack(b"ABAT", 1, 0, len(header), len(body), 0) + header + padding + body
    with pytest.raises(MessageError):
        decode(data)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        decode(data)


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_every_truncation_is_refused(message: Message) -> None:
    data = bytes(encode(message))
    for length in range(0, len(data), max(1, len(data) // 200)):
        with pytest.raises(MessageError):
            decode(data[:length])
    with pytest.raises(MessageError, match="size"):
        decode(data + bytes(8))


def with_value(field: str, index: int, value: float) -> Insert:
    one = chunk()
    array = getattr(one, field).copy()
    array.reshape(-1)[index] = value
    return insert(one._replace(**{field: array}))


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (with_value("frames", 100, np.nan), "frames must be finite"),
        (with_value("rewards", 0, np.inf), "rewards must be finite"),
        (with_value("priorities", 0, np.nan), "priorities must be finite"),
        (with_value("priorities", 0, 1e30), "priorities must be finite"),
        (with_value("discounts", 0, 1.5), "discounts must be finite and within 0 and 1"),
        (with_value("spans", 0, 0), "spans must be finite and within 1"),
        (with_value("spans", 3, 4), "beyond its chunk"),
        (with_value("starts", 3, 60_000), "beyond its chunk"),
        (with_value("starts", 1, 3), "do not increase"),
        (with_value("actions", 2, 3), "an action does not exist"),
        (with_value("actions", 2, NO_ACTION), "an action does not exist"),
    ],
)
def test_an_insert_with_wrong_values_is_refused_and_keeps_its_sender(message: Insert, why: str) -> None:
    with pytest.raises(MessageError, match=why) as caught:
        decode(encode(message))
    assert isinstance(caught.value.head, InsertHeader)
    assert caught.value.head.actor == "actor 3"


def test_starts_may_begin_anew_in_the_next_chunk() -> None:
    assert len(decode(encode(insert(chunk(4), chunk(4)))).chunks) == 2  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (Sample(1, batch()._replace(weights=np.full(5, np.nan, np.float32))), "weights"),
        (Standing(1, 5, float("nan"), 0, 0.4), "number|float|finite|range"),
        (Sample(1, batch(), Standing(1, 5, 1.0, 0, 0.4, float("inf"))), "number|float|finite|range"),
        (Sample(1, batch()._replace(actions=np.full(5, 3, np.uint8))), "actions"),
        (PriorityUpdate(1, np.array([-1]), np.array([1.0], np.float32)), "items"),
        (PriorityUpdate(1, np.array([1]), np.array([np.nan], np.float32)), "priorities"),
        (Weights(1, 1, {"w": np.array([np.inf], np.float32)}), "w must be finite"),
        (Report("a", 1, "h", "a", "s", {"x": float("nan")}), "metric"),
    ],
)
def test_other_wrong_values_are_refused(message: Message, why: str) -> None:
    with pytest.raises(MessageError, match=why):
        decode(encode(message))


def test_another_generation_or_protocol_is_refused() -> None:
    data = encode(Ack(1, 1), generation=4)
    assert decode(data, 4) == decode(data) == Ack(1, 1)
    with pytest.raises(MessageError, match="generation: 4, this address has 5"):
        decode(data, 5)
    data[4] = 1
    with pytest.raises(MessageError, match="protocol: version 1, this side speaks 2"):
        decode(data, 4)


def test_a_wrong_dtype_or_shape_is_refused_by_the_sender() -> None:
    with pytest.raises(ValueError, match="float64"):
        encode(insert(chunk()._replace(rewards=np.zeros(4))))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"\(3,\)"):
        encode(insert(chunk()._replace(rewards=np.zeros(3, np.float32))))


def test_fifty_transitions_take_about_as_many_bytes_as_their_frames() -> None:
    one = insert(chunk(50))
    assert len(encode(one)) < one.chunks[0].frames.nbytes * 1.15
