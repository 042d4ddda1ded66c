"""Whatever comes by the wire is a right message or a MessageError, and the replay takes every right message."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_bat.transport.framing import PREFIX
from apex_bat.transport.messages import MessageError, decode, encode
from tests.fuzz.fuzz_messages import SEEDS, fuzz, sealed, take, unsealed, with_prefix

CORPUS = sorted((Path(__file__).parent / "corpus" / "messages").iterdir())
KINDS = sorted(SEEDS)
NUMBERS = st.one_of(
    st.integers(-(2**63), 2**64 - 1), st.sampled_from([0, 1, 255, 65_535, 65_536, 2**31, 2**62, 10**12])
)
VALUES = st.recursive(
    st.one_of(NUMBERS, st.floats(), st.text(max_size=9), st.binary(max_size=9), st.none(), st.booleans()),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=3)),
    max_leaves=8,
)


def header_and_body(kind: str) -> tuple[dict[str, object], bytes]:
    data = bytes(encode(SEEDS[kind]))
    _, _, _, header_bytes, body_bytes, _ = PREFIX.unpack_from(data)
    header = msgspec.msgpack.decode(data[PREFIX.size : PREFIX.size + header_bytes])
    return header, data[len(data) - body_bytes :]


@pytest.mark.parametrize("kind", KINDS)
def test_a_right_message_is_still_right_when_it_is_sealed_anew(kind: str) -> None:
    header, body = header_and_body(kind)
    decode(with_prefix(msgspec.msgpack.encode(header), body))
    decode(sealed(unsealed(SEEDS[kind])))


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_header_with_other_values_is_refused_or_right(kind: str, data: st.DataObject) -> None:
    header, body = header_and_body(kind)
    for _ in range(data.draw(st.integers(1, 2))):
        header[data.draw(st.sampled_from(sorted(header)))] = data.draw(VALUES)
    take(with_prefix(msgspec.msgpack.encode(header), body))


@pytest.mark.parametrize("kind", ["insert", "sample", "priorities", "weights"])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_body_with_other_bytes_is_refused_or_right(kind: str, data: st.DataObject) -> None:
    header, right = header_and_body(kind)
    body = bytearray(right)
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(body) - 1))
        body[place] = data.draw(st.sampled_from([0, 1, 3, 127, 128, 254, 255]))
    take(with_prefix(msgspec.msgpack.encode(header), bytes(body)))


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=400))
def test_any_bytes_are_refused_or_right(data: bytes) -> None:
    fuzz(data)


@pytest.mark.parametrize(
    ("kind", "lie"),
    [
        ("insert", {"rows": [65_535] * 4096, "transitions": [65_535] * 4096, "first_steps": [0] * 4096}),
        ("sample", {"size": 65_536, "memory_steps": 255}),
        ("priorities", {"size": 1 << 20}),
        ("weights", {"names": ["a"], "shapes": [[2**31] * 8]}),
        ("weights", {"names": ["a"], "shapes": [[10**6, 10**6]]}),
    ],
)
def test_shapes_that_lie_take_no_memory(kind: str, lie: dict[str, object]) -> None:
    header, body = header_and_body(kind)
    message = with_prefix(msgspec.msgpack.encode(header | lie), body)
    tracemalloc.start()
    try:
        with pytest.raises(MessageError, match="shape"):
            decode(message)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.name)
def test_the_corpus_of_the_fuzzer_is_taken_as_documented(path: Path) -> None:
    fuzz(path.read_bytes())
