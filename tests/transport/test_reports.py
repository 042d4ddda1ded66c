"""Reports reach the launcher, or are dropped without a wait."""

from __future__ import annotations

import math
import time

import msgspec
import pytest
import zmq

from apex_bat.transport.messages import Report, Waiting, encode
from apex_bat.transport.reports import ReportCollector, Reporter
from apex_bat.transport.sockets import Connection


def report(**metrics: float) -> Report:
    return Report("actor", 12, "host", "ipc:///x", "flying", metrics)


def delivered(reporter: Reporter, collector: ReportCollector, one: Report) -> list[Report]:
    ends_s = time.monotonic() + 10
    while not reporter.send(one):
        assert time.monotonic() < ends_s
        collector.poll(0.01)
    return collector.poll(5.0)


def test_reports_arrive_without_metrics_that_are_not_finite() -> None:
    collector = ReportCollector("tcp://127.0.0.1:0")
    reporter = Reporter(collector.address)
    try:
        assert delivered(reporter, collector, report(loss=math.nan, steps=3.0)) == [report(steps=3.0)]
        assert collector.poll(0.0) == []
    finally:
        reporter.close()
        collector.close()


def test_without_a_launcher_reports_are_dropped_and_counted() -> None:
    collector = ReportCollector("tcp://127.0.0.1:0")
    collector.close()
    reporter = Reporter(collector.address)
    try:
        assert not any(reporter.send(report()) for _ in range(5))
        assert reporter.dropped == 5
    finally:
        reporter.close()


def test_nonsense_is_refused_and_the_next_report_arrives() -> None:
    collector = ReportCollector("tcp://127.0.0.1:0")
    stranger, reporter = Connection(zmq.PUSH, collector.address), Reporter(collector.address)
    try:
        stranger.socket.send(b"nonsense")
        ends_s = time.monotonic() + 10
        while not collector.refusals.total:
            assert time.monotonic() < ends_s
            assert collector.poll(0.01) == []
        assert delivered(reporter, collector, report()) == [report()]
    finally:
        stranger.close()
        reporter.close()
        collector.close()


def test_a_flood_is_refused_by_reason_and_a_poll_still_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apex_bat.transport.reports.AT_ONCE", 4)
    collector = ReportCollector("tcp://127.0.0.1:0", generation=7, roles=["actor-0"])
    stranger = Connection(zmq.PUSH, collector.address)
    expected = {"foreign": 2, "parts": 1, "unexpected": 1, "role": 1, "generation": 1}
    try:
        stranger.socket.send(b"no message of ours at all")
        stranger.socket.send(b"nor is this, whatever it says")
        stranger.socket.send_multipart([b"one", b"two"])
        stranger.socket.send(encode(Waiting("for nobody"), 7))
        stranger.socket.send(encode(msgspec.structs.replace(report(), role="../../etc/passwd"), 7))
        stranger.socket.send(encode(msgspec.structs.replace(report(), role="actor-0")))
        ends_s = time.monotonic() + 10
        while collector.refusals.counts != expected:
            assert time.monotonic() < ends_s, collector.refusals.counts
            before = collector.refusals.total
            assert collector.poll(0.01) == []
            assert collector.refusals.total - before <= 4
    finally:
        stranger.close()
        collector.close()


def test_what_a_former_life_of_a_role_still_says_is_refused() -> None:
    """A node that was cut off delivers, when it is back, what its role said meanwhile."""
    collector = ReportCollector("tcp://127.0.0.1:0", generation=1)
    former, present = (Reporter(collector.address, generation=number) for number in (5, 6))
    try:
        collector.generations["actor"] = 6
        assert delivered(former, collector, report()) == []
        assert collector.refusals.counts["generation"] == 1
        assert delivered(present, collector, report()) == [report()]
        other = msgspec.structs.replace(report(), role="other")
        assert delivered(present, collector, other) == [], "others go by the generation of the address"
    finally:
        former.close()
        present.close()
        collector.close()
