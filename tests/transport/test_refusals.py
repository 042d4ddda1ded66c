"""Refusals are all counted and seldom told."""

from __future__ import annotations

import logging

import pytest

from apex_bat.transport.refusals import LOG_PERIOD_S, Refusals


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
