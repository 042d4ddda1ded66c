"""The learner's side of a server: whole batches by the law, parts at once."""

from __future__ import annotations

import logging
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from apex_bat.config.settings import Config
from apex_bat.experience import Chunk
from apex_bat.replay.outlet import Outlet
from apex_bat.replay.store import ReplayStore
from apex_bat.transport.messages import Message, PartRequest, Sample, SampleRequest, Standing
from apex_bat.transport.refusals import Refusals

MakeChunk = Callable[..., Chunk]


class Learner:
    """A store, its outlet, and what was sent."""

    def __init__(self, config: Config) -> None:
        self.store = ReplayStore(config, np.random.default_rng(0))
        self.refusals = Refusals(logging.getLogger(__name__))
        self.got: list[Message] = []
        self.is_there = True
        self.outlet = Outlet(config, self.store, self.refusals, self._take)

    def _take(self, _peer: bytes, message: Message) -> bool:
        self.got.append(message)
        return self.is_there

    def ask(self, request: SampleRequest | PartRequest) -> bool:
        self.outlet.arrive(b"p", request)
        return self.outlet.answer_next()


@pytest.fixture
def learner(config: Config) -> Learner:
    return Learner(config)


def test_a_whole_batch_waits_for_the_law_and_a_part_does_not(learner: Learner, make_chunk: MakeChunk) -> None:
    learner.store.add("a", 0, [make_chunk(10)])
    assert not learner.ask(SampleRequest(1, 16, 0)), "20 are needed for the first sample"
    learner.outlet.requests.take()
    assert learner.ask(PartRequest(2, 5, 3, 0))
    [sample] = learner.got
    assert isinstance(sample, Sample)
    assert len(sample.batch.items) == 5
    assert sample.standing is not None
    assert (sample.standing.request, sample.standing.held) == (2, 10)
    assert sample.standing.total == pytest.approx(learner.store.buffer.total)
    assert learner.store.limiter.sampled == 3, "it is charged what it was told, not what it drew"
    assert learner.store.metrics()["replay.drawn"] == 5


def test_a_part_tells_what_is_earned_after_it_was_counted(learner: Learner, make_chunk: MakeChunk) -> None:
    learner.store.add("a", 0, [make_chunk(20)])
    before = learner.store.limiter.earned
    learner.ask(PartRequest(1, 4, 10, 0))
    sample = learner.got[0]
    assert isinstance(sample, Sample)
    assert sample.standing is not None
    assert sample.standing.earned == before - 10 == learner.store.limiter.earned


@pytest.mark.parametrize("size", [0, 4])
def test_an_empty_server_or_a_question_is_answered_by_how_it_stands(learner: Learner, size: int) -> None:
    assert learner.ask(PartRequest(7, size, 0, 0))
    [standing] = learner.got
    assert isinstance(standing, Standing)
    assert (standing.request, standing.held, standing.total, standing.earned) == (7, 0, 0.0, 0)
    assert "20 transitions are missing" in standing.reason


def test_parts_above_the_batch_and_whole_batches_of_another_size_are_refused(learner: Learner) -> None:
    for request in (PartRequest(1, 17, 0, 0), SampleRequest(2, 15, 0), SampleRequest(3, 17, 0)):
        assert not learner.ask(request)
    assert learner.refusals.counts == {"batch_size": 3}


def test_a_batch_that_went_nowhere_is_not_counted(learner: Learner, make_chunk: MakeChunk) -> None:
    learner.store.add("a", 0, [make_chunk(20)])
    learner.is_there = False
    assert learner.ask(SampleRequest(1, 16, 0))
    assert learner.store.limiter.sampled == 0


def test_a_part_that_went_nowhere_is_not_charged(learner: Learner, make_chunk: MakeChunk) -> None:
    learner.store.add("a", 0, [make_chunk(20)])
    learner.is_there = False
    for size in (4, 0):
        assert learner.ask(PartRequest(1 + size, size, 3, 0))
    assert learner.store.limiter.sampled == 0


def test_the_total_that_is_told_is_that_of_the_exponent_at_the_learners_step(
    config: Config, make_chunk: MakeChunk
) -> None:
    replay = msgspec.structs.replace(config.replay, alpha=1.0, alpha_end=0.1, anneal_updates=100)
    learner = Learner(msgspec.structs.replace(config, replay=replay))
    learner.store.add("a", 0, [make_chunk(20)])
    for step in (0, 100):
        learner.ask(PartRequest(1 + step, 0, 0, step))
    first, last = learner.got
    assert isinstance(first, Standing)
    assert isinstance(last, Standing)
    priorities = learner.store.buffer.some_priorities(20).astype(np.float64)
    assert (first.total, last.total) == pytest.approx((priorities.sum(), (priorities**0.1).sum()))
