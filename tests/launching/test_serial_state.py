"""Saved states: at every moment of a saving one is whole, and the newest whole one is found."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apex_bat.config import load
from apex_bat.launching import serial_state
from apex_bat.replay.store import ReplayStore
from apex_bat.storage import State

CONFIG = load(None, ["replay.capacity=900", "replay.min_size=100", "bats_per_actor=2", "actor.chunk_transitions=10"])


class Killed(BaseException):
    """The process ends here: nothing that comes later in it takes place."""


class Killer:
    """Stands in for what changes folders, and ends the process before one of its calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, before_call: int) -> None:
        self._calls_left = before_call
        self.is_dead = False
        for owner, name in ((shutil, "rmtree"), (Path, "replace"), (Path, "mkdir"), (os, "fsync")):
            monkeypatch.setattr(owner, name, self._deadly(getattr(owner, name)))

    def _deadly(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def perhaps(*arguments: Any, **options: Any) -> Any:
            if self.is_dead:
                raise Killed
            if self._calls_left == 0:
                self.is_dead = True
                raise Killed
            self._calls_left -= 1
            return call(*arguments, **options)

        return perhaps


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder with metrics and without checkpoints."""
    for name in ("metrics", "checkpoints"):
        (tmp_path / name).mkdir()
    (tmp_path / "metrics" / "replay.jsonl").write_bytes(b"{}\n")
    return tmp_path


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    logging.disable(logging.ERROR)
    yield
    logging.disable(logging.NOTSET)


def store() -> ReplayStore:
    return ReplayStore(CONFIG, np.random.default_rng(0))


def write(run: Path, turn: int, mark: str) -> None:
    serial_state.write(run, turn, State({"mark": mark}, {}), store())


def newest(run: Path) -> str:
    saved = serial_state.read_newest(run, store())
    assert saved is not None
    return str(saved.state.values["mark"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # the writer's thread dies too
@pytest.mark.parametrize("turn", [7, 5], ids=["a later turn", "the same turn again"])
def test_a_kill_at_any_moment_leaves_the_state_before_or_the_new_one(
    turn: int, run: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    write(run, 5, "before")
    found: list[str] = []
    for before_call in range(100):
        copy = tmp_path_factory.mktemp("killed") / "run"
        shutil.copytree(run, copy)
        with pytest.MonkeyPatch.context() as patch:
            killer = Killer(patch, before_call)
            with suppress(Killed):
                write(copy, turn, "new")
        found.append(newest(copy))
        write(copy, turn, "after the restart")
        assert newest(copy) == "after the restart"
        if not killer.is_dead:
            break
    assert found[0] == "before"
    assert found[-1] == "new"
    assert found == sorted(found), "first always the one before, then always the new one"


def test_a_second_state_of_a_turn_takes_the_place_of_the_first(run: Path) -> None:
    write(run, 3, "earlier")
    for mark in ("first", "second", "third"):
        write(run, 5, mark)
        assert newest(run) == mark
        assert len(serial_state.find(run)) == 2, "the state of the turn before stays beside it"
    write(run, 40, "later")
    assert newest(run) == "later"
    assert [path.name for path in serial_state.find(run)] == ["turn-000000000005.3", "turn-000000000040"]


def test_states_are_found_in_the_order_of_their_moments(run: Path) -> None:
    for name in ("turn-000000000010", "turn-000000000009.2", "turn-000000000009", "turn-000000000009.10", "turn-9"):
        (run / "serial" / name).mkdir(parents=True)
    names = [path.name.removeprefix("turn-0000000000") for path in serial_state.find(run)]
    assert names == ["09", "09.2", "09.10", "10"]
