"""What a full disk costs is counted and said, once a minute, and stops nobody."""

from __future__ import annotations

import logging

import pytest

from apex_bat.launching.lost_writes import LostWrites
from apex_bat.storage import StorageError


def test_each_lost_write_is_counted_and_one_a_minute_is_said(caplog: pytest.LogCaptureFixture) -> None:
    now_s = [0.0]
    writes = LostWrites(lambda: now_s[0])
    with caplog.at_level(logging.ERROR):
        for now_s[0] in (0.0, 1.0, 59.0, 60.0):
            with writes.borne():
                raise StorageError("rows: cannot be written: No space left on device")
    assert writes.number == 4
    assert [record.message for record in caplog.records] == [
        "rows: cannot be written: No space left on device; training goes on, and 1 writes were lost so far",
        "rows: cannot be written: No space left on device; training goes on, and 4 writes were lost so far",
    ]


def test_mistakes_of_ours_are_not_borne() -> None:
    with pytest.raises(KeyError), LostWrites().borne():
        raise KeyError("typing error")
