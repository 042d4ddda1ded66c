"""A fleet on hosts that the test plays."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from apex_bat.launching.cluster import lease
from apex_bat.launching.cluster.fleet import Fleet
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import new_keys
from tests.launching.cluster.stage import CONFIG, Stage


@pytest.fixture
def stage() -> Stage:
    return Stage()


@pytest.fixture
def fleet(stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    monkeypatch.setattr(lease, "IMPORTS_S", 0.0)  # nothing imports here
    collector = ReportCollector("tcp://127.0.0.1:0", keys=new_keys())
    with Fleet(CONFIG, tmp_path, collector, new_keys(), stage) as one:
        yield one
    collector.close()
