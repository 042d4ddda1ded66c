"""Fuzzes every decoder of messages, and the replay behind them.

By hand, guided by coverage: `python -m tests.fuzz.fuzz_messages [libFuzzer's options] [corpus folders]`, which wants
atheris (the extra `fuzz`). The quick suite calls the same targets with what hypothesis makes up and with the corpus.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache

import numpy as np

from apex_bat.config.settings import Actor, Config, Learner, Replay
from apex_bat.experience import NO_ACTION, Batch, Chunk, States
from apex_bat.replay.arrivals import Arrival, Arrivals
from apex_bat.replay.store import RefusedChunkError, ReplayStore
from apex_bat.transport.framing import MAGIC, PREFIX, PROTOCOL
from apex_bat.transport.messages import (
    Ack,
    Insert,
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
from tests.fuzz.guided import run


def chunk(transitions: int = 4, first_step: int = 9) -> Chunk:
    """Returns a chunk of a bat, the same for the same arguments."""
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


def batch(size: int = 2) -> Batch:
    """Returns a batch of zeros."""
    states = States(np.zeros((size, 6, 24), np.float32), np.zeros((size, 3), np.uint8))
    zeros = np.zeros(size, np.float32)
    return Batch(np.arange(size), zeros, states, np.zeros(size, np.uint8), zeros, zeros, states)


SEEDS: dict[str, Message] = {
    "insert": Insert("actor-3", 2**61, 1, 1, 1200, (chunk(1), chunk(2, 0))),
    "ack": Ack(5, 6, "because"),
    "waiting": Waiting("for actors"),
    "request": SampleRequest(1, 16, 9),
    "sample": Sample(1, batch()),
    "part": PartRequest(3, 0, 64, 9),
    "standing": Standing(3, 500, 12.5, 90, 0.4, 1.5, "because"),
    "sampled part": Sample(3, batch(), Standing(3, 500, 12.5, 90, 0.4, 1.5)),
    "priorities": PriorityUpdate(4, np.arange(3), np.array([0.5, -1.0, 2.0], np.float32)),
    "ratio": RatioChange(2.5),
    "ratio_now": Ratio(2.5, 800.0, "because"),
    "weights": Weights(3, 75, {"a.weight": np.ones((2, 3), np.float32), "a.bias": np.zeros((), np.float32)}),
    "subscription": Subscription(-1, 75),
    "report": Report("actor-0", 77, "host", "ipc:///x", "flying", {"steps_per_s": 1.5}),
}
"""A right message of each kind, small."""


def fuzz(data: bytes) -> None:
    """Decodes bytes as they are, and once more sealed: behind a prefix that fits, so that what is inside is reached."""
    take(data)
    take(sealed(data))


def sealed(data: bytes) -> bytes:
    """Returns a message with a right prefix whose first two bytes tell where the header of the rest ends."""
    length = int.from_bytes(data[:2], "little") % (len(data) + 1)
    header, body = data[2 : 2 + length], data[2 + length :]
    body += bytes(-len(body) % 8)
    return with_prefix(header, body)


def with_prefix(header: bytes, body: bytes) -> bytes:
    """Returns the message of a header and a body, with sizes that are right."""
    padding = bytes(-(PREFIX.size + len(header)) % 8)
    return PREFIX.pack(MAGIC, PROTOCOL, 0, len(header), len(body), 0) + header + padding + body


def take(data: bytes) -> None:
    """Decodes a message and does with it what the replay does; nothing but what is documented may be raised."""
    try:
        message = decode(data)
    except MessageError:
        return
    np.testing.assert_equal(decode(encode(message)), message)
    with suppress(RefusedChunkError):
        handle(message)


def handle(message: Message) -> None:
    """Gives a decoded message to a small replay that has taken all those before it."""
    store, arrivals = _replay()
    match message:
        case Insert():
            arrivals.offer(Arrival(message, ""), b"peer")
            if arrivals.peek() is not None:
                arrivals.settle()
            store.add(message.actor, message.learner_step, message.chunks)
        case PriorityUpdate(learner_step, items, priorities):
            store.update(learner_step, items, priorities)
        case SampleRequest():
            if store.can_sample(16):
                found = store.sample(16, message.learner_step)
                assert np.isfinite(found.weights).all()


@cache
def _replay() -> tuple[ReplayStore, Arrivals]:
    config = Config(
        bats_per_actor=2,
        replay=Replay(capacity=200, min_size=20, samples_per_insert=4.0, never_block=True),
        actor=Actor(chunk_transitions=10, window_chunks=8),
        learner=Learner(batch_size=16, prefetch=2),
    )
    return ReplayStore(config, np.random.default_rng(0)), Arrivals(8)


def unsealed(message: Message) -> bytes:
    """Returns what `sealed` makes a message of again: a seed."""
    data = bytes(encode(message))
    _, _, _, header_bytes, body_bytes, _ = PREFIX.unpack_from(data)
    header = data[PREFIX.size : PREFIX.size + header_bytes]
    return len(header).to_bytes(2, "little") + header + data[len(data) - body_bytes :]


if __name__ == "__main__":
    run("tests.fuzz.fuzz_messages")
