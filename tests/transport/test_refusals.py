"""Refusals are all counted and seldom told."""

from __future__ import annotations

import logging
from typing import get_args

import pytest

from apex_bat.transport.framing import Fault
from apex_bat.transport.refusals import LOG_PERIOD_S, PUBLISHER_REASONS, REASONS, Refusals


def test_a_flood_is_counted_and_logged_once_a_period_and_reason(caplog: pytest.LogCaptureFixture) -> None:
    now = [0.0]
    refusals = Refusals(logging.getLogger("test"), clock=lambda: now[0])
    for _ in range(1000):
        refusals.count("size", "too long")
    refusals.count("value", "not finite")
    assert refusals.counts == {"size": 1000, "value": 1}
    assert refusals.total == 1001
    assert len(caplog.records) == 2
    now[0] = LOG_PERIOD_S
    refusals.count("size", "too long")
    assert "1000 since the last line" in caplog.text


def test_what_a_stranger_sent_is_logged_as_one_line_without_escapes(caplog: pytest.LogCaptureFixture) -> None:
    Refusals(logging.getLogger("test")).count("header", "a\nforged line \x1b[31m and more" + "x" * 10_000)
    assert "a?forged line ?[31m and more" in caplog.text
    assert len(caplog.records[0].getMessage()) < 1000


def test_every_fault_of_a_message_is_a_declared_reason() -> None:
    assert set(get_args(Fault)) <= set(REASONS)
    assert set(PUBLISHER_REASONS) <= set(REASONS)
