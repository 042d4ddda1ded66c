"""Several servers as if they were one: the same distribution, the same law, and nobody waits for one that is lost.

The servers are stores and their outlets in this thread; what is sent waits in lists, which a test may lose.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from apex_bat.config.settings import Config
from apex_bat.experience import Batch, Chunk
from apex_bat.replay.outlet import Outlet
from apex_bat.replay.spread import SpreadBatches
from apex_bat.replay.store import ReplayStore
from apex_bat.transport.messages import Message, PartRequest
from apex_bat.transport.refusals import Refusals

MakeChunk = Callable[..., Chunk]
BATCH = 16


class Fleet:
    """Some servers and the learner's end of them."""

    def __init__(self, config: Config, num_servers: int = 2) -> None:
        replay = msgspec.structs.replace(config.replay, shards=num_servers, alpha=1.0, priority_epsilon=1e-6)
        self.config = msgspec.structs.replace(config, replay=replay)
        self.now_s = 0.0
        self.down: set[int] = set()
        self.silent: set[int] = set()
        self.full: set[int] = set()  # whose queues take nothing now
        self.answers: list[deque[Message]] = [deque() for _ in range(num_servers)]
        self.stores: list[ReplayStore] = []
        self.outlets: list[Outlet] = []
        for number in range(num_servers):
            self.stores.append(ReplayStore(self.config, np.random.default_rng(number)))
            self.outlets.append(self._outlet(number))
        self.sent = 0
        self.spread = SpreadBatches(
            num_servers, BATCH, self._send, 2.0, np.random.default_rng(9), clock=lambda: self.now_s
        )

    def begin_anew(self, number: int) -> None:
        """Replaces a server by one that holds nothing."""
        self.stores[number] = ReplayStore(self.config, np.random.default_rng(50 + number))
        self.outlets[number] = self._outlet(number)
        self.answers[number].clear()
        self.down.discard(number)

    def answer(self) -> list[Batch]:
        """Lets every server answer all it was asked; returns the batches that are complete by that."""
        batches = []
        for number, outlet in enumerate(self.outlets):
            if number in self.down | self.silent:
                continue
            while outlet.answer_next():
                pass
            while self.answers[number]:
                batch = self.spread.take(number, self.answers[number].popleft())
                batches += [] if batch is None else [batch]
        return batches

    def draw(self, number: int, prefetch: int = 4) -> list[Batch]:
        """Returns so many batches, with `prefetch` under way."""
        batches: list[Batch] = []
        for _ in range(20 * number + 200):
            self.now_s += 0.03
            self.spread.ask(prefetch - self.spread.under_way, 0)
            batches += self.answer()
            if len(batches) >= number:
                return batches
        raise AssertionError(f"only {len(batches)} of {number} batches; {self.spread.reason()}")

    def _send(self, number: int, message: Message) -> bool:
        assert isinstance(message, PartRequest)
        if number in self.down | self.full:
            return False
        self.sent += 1
        self.outlets[number].arrive(b"learner", message)
        return True

    def _outlet(self, number: int) -> Outlet:
        def send(_peer: bytes, message: Message) -> bool:
            self.answers[number].append(message)
            return True

        return Outlet(self.config, self.stores[number], Refusals(logging.getLogger(__name__)), send)


@pytest.fixture
def free_running(config: Config) -> Config:
    return msgspec.structs.replace(config, replay=msgspec.structs.replace(config.replay, never_block=True))


def chi_square(batches: list[Batch], wanted: NDArray[np.float64]) -> float:
    items = np.concatenate([batch.items for batch in batches])
    expected = wanted / wanted.sum() * len(items)
    return float(((np.bincount(items, minlength=len(wanted)) - expected) ** 2 / expected).sum())


def filled(
    fleet: Fleet, make_chunk: MakeChunk, scales: tuple[float, ...], transitions: int = 20
) -> NDArray[np.float64]:
    """Fills the servers, one's priorities greater than the other's; returns the priorities by item number."""
    wanted = np.zeros(transitions * len(scales))
    for number, (store, scale) in enumerate(zip(fleet.stores, scales, strict=True)):
        chunk = make_chunk(transitions)
        chunk = chunk._replace(priorities=(scale * (0.2 + chunk.priorities)).astype(np.float32))
        store.add("a", 0, [chunk])
        wanted[number :: len(scales)] = chunk.priorities + 1e-6
    return wanted


@pytest.mark.parametrize("scales", [(1.0, 5.0), (3.0, 0.1, 1.0)])
def test_the_distribution_is_that_of_one_server_with_all_items(
    free_running: Config, make_chunk: MakeChunk, scales: tuple[float, ...]
) -> None:
    fleet = Fleet(free_running, len(scales))
    wanted = filled(fleet, make_chunk, scales)
    batches = fleet.draw(1500)
    assert chi_square(batches, wanted) < {40: 73, 60: 100}[len(wanted)]  # 0.1 % of a chi-square; stratified is below
    weights = np.concatenate([batch.weights / batch.weights.max() for batch in batches])
    assert weights.min() > 0
    for batch in batches[:20]:
        right = wanted[batch.items] ** -0.4
        np.testing.assert_allclose(batch.weights, right / right.max(), rtol=1e-4)


def test_old_totals_are_told_and_their_weights_are_right(free_running: Config, make_chunk: MakeChunk) -> None:
    fleet = Fleet(free_running)
    wanted = filled(fleet, make_chunk, (1.0, 1.0))
    fleet.draw(1, prefetch=1)
    fleet.spread.ask(1, 0)
    fleet.stores[0].update(0, np.arange(20), (5.0 * wanted[::2]).astype(np.float32))
    [batch] = fleet.answer()
    assert fleet.spread.counters()["reader.misplaced_share"] > 0.0
    chances = wanted / wanted.sum()  # of the servers by the totals they had told; within each, all as before
    right = chances[batch.items] ** -0.4
    np.testing.assert_allclose(batch.weights, right / right.max(), rtol=1e-4)


def test_the_ratio_holds_over_all_and_at_each_however_unequal_their_priorities(
    config: Config, make_chunk: MakeChunk
) -> None:
    fleet = Fleet(config)
    drawn = 0
    for _ in range(60):
        for store, priority in zip(fleet.stores, (0.01, 5.0), strict=True):
            while store.can_add(10):
                store.add("a", 0, [make_chunk(10, priority=priority)])
        drawn += len(fleet.draw(1, prefetch=1))
    inserted = [store.limiter.inserted for store in fleet.stores]
    assert fleet.stores[1].metrics()["replay.drawn"] > 20 * fleet.stores[0].metrics()["replay.drawn"]
    assert inserted[0] == pytest.approx(inserted[1], rel=0.4), "the one with low priorities is not held back"
    assert sum(store.limiter.sampled for store in fleet.stores) == BATCH * drawn
    for store in fleet.stores:
        assert abs(store.limiter.balance) <= store.limiter.error_buffer


@pytest.mark.parametrize("only", [0, 1])
def test_nobody_waits_for_ever_when_one_server_gets_all_inserts(
    config: Config, make_chunk: MakeChunk, only: int
) -> None:
    fleet = Fleet(config)
    for _ in range(40):
        while fleet.stores[only].can_add(10):
            fleet.stores[only].add("a", 0, [make_chunk(10)])
        assert fleet.draw(1, prefetch=1)


def test_no_batch_is_begun_before_its_samples_are_earned(config: Config, make_chunk: MakeChunk) -> None:
    fleet = Fleet(config)
    for store in fleet.stores:
        store.add("a", 0, [make_chunk(10)])
    num_batches = sum(store.limiter.earned for store in fleet.stores) // BATCH
    assert len(fleet.draw(num_batches, prefetch=16)) == num_batches
    for _ in range(50):
        fleet.now_s += 0.03
        fleet.spread.ask(16, 0)
        assert not fleet.answer()
    assert fleet.spread.under_way == 0
    fleet.stores[1].add("a", 0, [make_chunk(10)])
    assert fleet.draw(1)


def test_a_lost_server_holds_nothing_up_and_its_parts_are_drawn_from_the_others(
    free_running: Config, make_chunk: MakeChunk
) -> None:
    fleet = Fleet(free_running, 3)
    wanted = filled(fleet, make_chunk, (1.0, 2.0, 1.5))
    fleet.draw(20)
    fleet.spread.ask(8 - fleet.spread.under_way, 0)
    fleet.down.add(1)
    fleet.outlets[1].requests.__init__()  # type: ignore[misc]  # what it was asked dies with it
    batches = fleet.draw(1200, prefetch=8)
    counters = fleet.spread.counters()
    assert counters["reader.servers_away"] == 1
    assert counters["reader.parts_drawn_again"] >= 8
    assert all(len(batch.items) == BATCH for batch in batches)
    wanted[1::3] = 0.0
    held = wanted > 0
    items = np.concatenate([batch.items for batch in batches])
    assert held[items].all()
    expected = wanted[held] / wanted.sum() * len(items)
    assert ((np.bincount(items, minlength=60)[held] - expected) ** 2 / expected).sum() < 73

    fleet.begin_anew(1)
    fleet.draw(10)
    fleet.stores[1].add("a", 0, [make_chunk(20, priority=4.0)])
    late = np.concatenate([batch.items for batch in fleet.draw(100)[50:]])
    assert (late % 3 == 1).any(), "it is back"
    assert fleet.spread.counters()["reader.servers_away"] == 0


def test_a_server_that_falls_silent_is_left_out_and_its_late_answers_do_no_harm(
    free_running: Config, make_chunk: MakeChunk
) -> None:
    fleet = Fleet(free_running)
    filled(fleet, make_chunk, (1.0, 1.0))
    fleet.draw(4)
    fleet.spread.ask(4 - fleet.spread.under_way, 0)
    fleet.silent = {0}  # it takes what it is sent
    assert len(fleet.draw(50)) >= 50
    assert fleet.spread.counters()["reader.servers_away"] == 1
    fleet.silent = set()
    fleet.draw(50)
    assert fleet.spread.counters()["reader.servers_away"] == 0


@pytest.mark.parametrize("lost", [0, 1])
@pytest.mark.parametrize("is_silent", [False, True])
def test_the_law_charges_a_lost_server_nothing_when_all_samples_are_used_up(
    config: Config, make_chunk: MakeChunk, lost: int, is_silent: bool
) -> None:
    fleet = Fleet(config)
    for store in fleet.stores:
        store.add("a", 0, [make_chunk(10, priority=1.0)])
        store.count_sample(store.limiter.earned - BATCH)
    fleet.draw(1, prefetch=1)
    fleet.spread.ask(1, 0)
    assert fleet.spread.under_way == 1
    left = fleet.stores[1 - lost]
    wanted = left.limiter.sampled + BATCH
    (fleet.silent if is_silent else fleet.down).add(lost)
    # The last batch comes, whole, and is charged to the server that is left: with or without samples to its credit.
    [batch] = fleet.draw(1, prefetch=1)
    assert (batch.items % 2 == 1 - lost).all()
    for _ in range(50):
        fleet.now_s += 0.03
        fleet.spread.ask(1, 0)
        assert not fleet.answer()
    assert left.limiter.sampled == wanted
    assert fleet.spread.counters()["reader.servers_away"] == 1


def test_weights_are_right_when_a_lost_part_is_drawn_again_from_its_own_server(
    free_running: Config, make_chunk: MakeChunk
) -> None:
    fleet = Fleet(free_running)
    wanted = filled(fleet, make_chunk, (1.0, 1.0))
    share = wanted / np.array([wanted[0::2].sum(), wanted[1::2].sum()])[np.arange(40) % 2]
    total = fleet.stores[0].buffer.total
    fleet.stores[1].update(0, np.arange(20), (wanted[1::2] * total / wanted[1::2].sum()).astype(np.float32))
    fleet.draw(1, prefetch=1)
    batches: list[Batch] = []
    for _ in range(400):
        fleet.now_s += 0.03
        fleet.spread.ask(1, 0)
        fleet.outlets[1] = fleet._outlet(1)  # what it was asked for is gone; it is there, and holds what it held
        for _ in range(20):
            fleet.now_s += 0.3  # its next answer tells that the part is lost
            batches += fleet.answer()
            if not fleet.spread.under_way:
                break
            fleet.spread.ask(0, 0)
    assert fleet.spread.counters()["reader.servers_away"] == 0
    # Half of the draws fall to server 0, and so does half of what was lost: an item has 3/4 or 1/4 of its share.
    chances = share * np.array([0.75, 0.25])[np.arange(40) % 2]
    assert chi_square(batches, chances) < 73
    for batch in batches:
        right = chances[batch.items] ** -0.4
        np.testing.assert_allclose(batch.weights, right / right.max(), rtol=1e-3)


def test_who_was_stopped_for_a_while_gives_up_no_server_whose_answers_wait(
    free_running: Config, make_chunk: MakeChunk
) -> None:
    fleet = Fleet(free_running)
    filled(fleet, make_chunk, (1.0, 1.0))
    fleet.draw(4)
    fleet.spread.ask(4 - fleet.spread.under_way, 0)
    fleet.now_s += 5.0
    fleet.draw(10)
    assert fleet.spread.counters()["reader.servers_away"] == 0
    assert fleet.spread.counters()["reader.parts_drawn_again"] == 0


def test_a_full_queue_loses_no_server_if_it_empties_soon(free_running: Config, make_chunk: MakeChunk) -> None:
    fleet = Fleet(free_running)
    filled(fleet, make_chunk, (1.0, 1.0))
    fleet.draw(4)
    fleet.full = {1}
    for _ in range(5):
        fleet.now_s += 0.03
        fleet.spread.ask(4 - fleet.spread.under_way, 0)
        fleet.answer()
    assert fleet.spread.under_way == 4
    assert fleet.spread.is_behind
    fleet.full = set()
    fleet.draw(10)
    assert fleet.spread.counters()["reader.servers_away"] == 0
    assert fleet.spread.counters()["reader.parts_drawn_again"] == 0


def test_with_all_servers_away_parts_wait_and_are_drawn_when_one_is_back(
    free_running: Config, make_chunk: MakeChunk
) -> None:
    fleet = Fleet(free_running)
    filled(fleet, make_chunk, (1.0, 1.0))
    fleet.draw(4)
    fleet.spread.ask(4 - fleet.spread.under_way, 0)
    fleet.down = {0, 1}
    for _ in range(200):
        fleet.now_s += 0.03
        fleet.spread.ask(0, 0)
    assert fleet.spread.silent() == 0
    assert fleet.spread.under_way
    fleet.down = {0}
    batches = fleet.draw(10)
    assert all((batch.items % 2 == 1).all() for batch in batches)


def test_a_server_that_lost_its_items_is_asked_for_nothing_more(free_running: Config, make_chunk: MakeChunk) -> None:
    fleet = Fleet(free_running)
    filled(fleet, make_chunk, (1.0, 1.0))
    fleet.draw(4)
    fleet.spread.ask(4 - fleet.spread.under_way, 0)
    fleet.begin_anew(0)  # with requests under way, and without anybody noticing
    batches = fleet.draw(30)
    assert all(len(batch.items) == BATCH for batch in batches)
    assert all((batch.items % 2 == 1).all() for batch in batches[8:])


def test_questions_do_not_pile_up(config: Config) -> None:
    fleet = Fleet(config)
    fleet.answer = list  # type: ignore[method-assign]
    for _ in range(100):
        fleet.now_s += 0.03
        fleet.spread.ask(4, 0)
    assert fleet.sent <= 2 * (1 + 3.0 / 2.0 + 1)
