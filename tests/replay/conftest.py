"""Chunks of flight and small settings for the tests of the replay."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from apex_bat.config.settings import Actor, Config, Learner, Replay
from apex_bat.experience import NO_ACTION, NUM_BINS, NUM_EARS, Chunk

MakeChunk = Callable[..., Chunk]
Until = Callable[..., None]


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def make_chunk(generator: np.random.Generator) -> MakeChunk:
    """Returns a maker of random chunks: context of 3 rows unless the episode begins, spans of up to 3."""

    def make(transitions: int = 10, first_step: int = 20, span: int = 3, priority: float | None = None) -> Chunk:
        context = 0 if first_step == 0 else 3
        rows = context + transitions + span
        actions = generator.integers(0, 3, rows).astype(np.uint8)
        actions[-1] = NO_ACTION
        priorities = generator.random(transitions, dtype=np.float32)
        if priority is not None:
            priorities[:] = priority
        return Chunk(
            first_step,
            generator.random((rows, NUM_EARS, NUM_BINS), dtype=np.float32),
            actions,
            np.arange(context, context + transitions, dtype=np.uint16),
            np.full(transitions, span, np.uint8),
            generator.random(transitions, dtype=np.float32),
            np.full(transitions, 0.9, np.float32),
            priorities,
        )

    return make


@pytest.fixture
def config() -> Config:
    """Small settings: 1,000 transitions, the first sample after 20, chunks of 10."""
    return Config(
        bats_per_actor=2,
        replay=Replay(capacity=1000, min_size=20, samples_per_insert=4.0, snapshot_period_s=0.0),
        actor=Actor(chunk_transitions=10, window_chunks=8),
        learner=Learner(batch_size=16, prefetch=2),
    )


@pytest.fixture
def until() -> Until:
    """Returns a loop: it takes steps, which wait on sockets themselves, until a condition holds, for 10 s at most."""

    def loop(condition: Callable[[], object], *steps: Callable[[], object]) -> None:
        ends_s = time.monotonic() + 10.0
        while not condition():
            assert time.monotonic() < ends_s, "it did not happen within 10 s"
            for step in steps:
                step()

    return loop
