"""A run that its disk cannot hold is told so in one line, and starts all the same."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from apex_bat.config import load
from apex_bat.launching.space import bounds_of, snapshot_bytes, warn_if_short
from apex_bat.replay.store import ReplayStore

BASE = ("replay.capacity=20000", "recording.max_mb=700", "launch.log_max_mb=2", "launch.log_files=1", "actors=3")


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Bytes that are free on every disk; a test may change it."""
    space = [0.0]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=space[0]))
    return space


def test_the_bounds_are_those_of_the_settings() -> None:
    config = load(None, list(BASE))
    bounds = bounds_of(config)
    assert bounds["recordings"] == 700e6
    assert bounds["logs"] == 2e6 * 2 * 7, (
        "three actors, replay, learner, evaluator and launcher, each with a former log"
    )
    assert bounds["replay"] == 3 * snapshot_bytes(config)


@pytest.mark.parametrize("changes", [(), ("actor.chunk_transitions=9", "learner.num_step=1"), ("replay.shards=3",)])
def test_a_snapshot_is_as_large_as_the_arrays_of_the_replay(changes: tuple[str, ...]) -> None:
    config = load(None, [*BASE, *changes])
    buffer = ReplayStore(config, np.random.default_rng(0)).buffer
    arrays = (*buffer.row_arrays().values(), *buffer.item_arrays().values())
    of_all_shards = config.replay.shards * sum(array.nbytes for array in arrays)
    assert snapshot_bytes(config) == pytest.approx(of_all_shards, rel=1e-3)


def test_a_replay_beyond_the_memory_of_this_machine_is_reckoned_with() -> None:
    assert snapshot_bytes(load(None, ["replay.capacity=1_000_000_000_000"])) > 2e14


@pytest.mark.parametrize("change", ["replay.capacity=40000", "checkpoint.keep=50", "recording.max_mb=900", "actors=9"])
def test_a_larger_setting_needs_more(change: str) -> None:
    assert sum(bounds_of(load(None, [*BASE, change])).values()) > sum(bounds_of(load(None, list(BASE))).values())


def test_too_little_space_is_one_warning(free: list[float], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = load(None, list(BASE))
    free[0] = sum(bounds_of(config).values()) - 1.0
    text = warn_if_short(config, tmp_path)
    assert [record.message for record in caplog.records] == [text]
    assert text.startswith(f"{tmp_path}: its disk has 0.7")
    assert "recordings 0.7" in text
    assert "\n" not in text
    free[0] += 1.0
    assert warn_if_short(config, tmp_path) == ""


def test_what_a_resumed_run_holds_already_is_not_asked_for_again(free: list[float], tmp_path: Path) -> None:
    config = load(None, list(BASE))
    free[0] = sum(bounds_of(config).values()) - 1000.0
    assert warn_if_short(config, tmp_path)
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "a.rrd").write_bytes(bytes(1000))
    assert not warn_if_short(config, tmp_path)


def test_a_disk_that_does_not_tell_is_not_complained_of(tmp_path: Path) -> None:
    assert warn_if_short(load(None, list(BASE)), tmp_path / "nowhere") == ""
