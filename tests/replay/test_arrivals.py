"""What becomes of inserts that come late, twice, too early or from a twin."""

from __future__ import annotations

import pytest

from apex_bat.replay.arrivals import Arrival, Arrivals
from apex_bat.transport.messages import InsertHeader


def arrival(sequence: int, actor: str = "a", incarnation: int = 1, first_unacknowledged: int = 1) -> Arrival:
    return Arrival(InsertHeader(actor, incarnation, sequence, first_unacknowledged, 0, (0,), (5,), (1,)), "")


def settle_all(arrivals: Arrivals) -> list[tuple[str, int]]:
    settled = []
    while (first := arrivals.peek()) is not None:
        settled.append((first.header.actor, first.header.sequence))
        arrivals.settle()
    return settled


def test_each_insert_is_taken_once_and_in_order() -> None:
    arrivals = Arrivals(10)
    assert arrivals.offer(arrival(1), b"x") == "queued"
    assert arrivals.offer(arrival(1), b"x") == "held"
    assert arrivals.offer(arrival(3), b"x") == "gap"
    assert arrivals.offer(arrival(2), b"x") == "queued"
    assert settle_all(arrivals) == [("a", 1), ("a", 2)]
    assert arrivals.offer(arrival(2), b"x") == "stored"
    assert len(arrivals) == 0


def test_actors_take_turns_however_much_each_sends() -> None:
    arrivals = Arrivals(10)
    for sequence in (1, 2, 3, 4):
        arrivals.offer(arrival(sequence, "fast"), b"x")
    arrivals.offer(arrival(1, "slow"), b"y")
    assert settle_all(arrivals) == [("fast", 1), ("slow", 1), ("fast", 2), ("fast", 3), ("fast", 4)]


def test_a_server_without_memory_goes_on_where_the_actor_is() -> None:
    arrivals = Arrivals(10)
    assert arrivals.offer(arrival(95, first_unacknowledged=95), b"x") == "queued"
    assert arrivals.offer(arrival(97, first_unacknowledged=95), b"x") == "gap"
    assert arrivals.offer(arrival(96, first_unacknowledged=95), b"x") == "queued"


def test_a_restarted_actor_joins_and_its_twin_is_refused() -> None:
    arrivals = Arrivals(10)
    arrivals.offer(arrival(1, incarnation=1), b"old")
    assert arrivals.offer(arrival(1, incarnation=2), b"new") == "queued"
    assert arrivals.offer(arrival(2, incarnation=1), b"old") == "superseded"
    assert arrivals.settle() is None  # the old one's experience is kept, but nobody is there to be told
    assert arrivals.settle() == b"new"


def test_more_than_the_window_is_not_taken() -> None:
    arrivals = Arrivals(2)
    verdicts = [arrivals.offer(arrival(sequence), b"x") for sequence in (1, 2, 3)]
    assert verdicts == ["queued", "queued", "flood"]


def test_acknowledgements_follow_the_newest_connection() -> None:
    arrivals = Arrivals(10)
    arrivals.offer(arrival(1), b"before")
    arrivals.offer(arrival(1), b"after")
    assert arrivals.waiting_peers() == [b"after"]
    assert arrivals.settle() == b"after"


def test_a_snapshot_knows_what_was_stored_and_not_what_waited() -> None:
    arrivals, restored = Arrivals(10), Arrivals(10)
    arrivals.offer(arrival(1, incarnation=1), b"x")
    arrivals.offer(arrival(1, incarnation=2), b"x")
    arrivals.offer(arrival(2, incarnation=2), b"x")
    arrivals.settle()
    arrivals.settle()
    restored.restore(arrivals.stored_sequences())
    assert restored.offer(arrival(1, incarnation=2), b"x") == "stored"
    assert restored.offer(arrival(2, incarnation=2), b"x") == "queued"
    assert restored.offer(arrival(9, incarnation=1), b"x") == "superseded"


def test_the_bytes_that_wait_are_bounded_over_all_actors() -> None:
    arrivals = Arrivals(8, max_bytes=100)

    def offer(actor: str, num_bytes: int) -> str:
        return arrivals.offer(Arrival(InsertHeader(actor, 1, 1, 1, 0, (0,), (9,), (1,)), "", num_bytes), b"peer")

    assert offer("large", 1000) == "queued"  # or it could never be
    assert offer("b", 10) == "flood"
    arrivals.settle()
    assert [offer("b", 60), offer("c", 60), offer("d", 40)] == ["queued", "flood", "queued"]
    arrivals.settle()
    assert offer("c", 60) == "queued"
    assert len(arrivals) == 2


def test_the_names_that_are_remembered_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apex_bat.replay.arrivals.MAX_ACTORS", 3)
    arrivals = Arrivals(8)

    def offer(actor: str) -> str:
        return arrivals.offer(Arrival(InsertHeader(actor, 1, 1, 1, 0, (0,), (9,), (1,)), ""), b"peer")

    assert [offer(name) for name in "abcdeaf"] == ["queued", "queued", "queued", "flood", "flood", "held", "flood"]
