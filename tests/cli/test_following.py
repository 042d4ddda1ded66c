"""`train`: what is noted of how a run ended, who may enter its folder meanwhile, and what is cleared away."""

from __future__ import annotations

import io
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from apex_bat.cli import following
from apex_bat.config import Config
from apex_bat.evaluation import runs
from apex_bat.evaluation.runs import RunError
from apex_bat.launching import live, local
from apex_bat.launching.course import Ended
from apex_bat.launching.lock import InUseError, locked
from tests.cli.conftest import Command


def interrupt(*_: object, **__: object) -> Any:
    raise KeyboardInterrupt


def complete(*_: object, **__: object) -> Ended:
    return Ended("completed", "", 100, 10, 1.0)


def outcome(run: Path) -> str:
    return str(json.loads((run / "run.json").read_text())["outcome"])


@pytest.mark.parametrize(("module", "name"), [(local, "train"), (live, "PlainView")], ids=["the roles", "the view"])
def test_ctrl_c_while_a_run_begins_is_no_failure(
    module: Any, name: str, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, name, interrupt)
    code, error = command(["train", "--plain", "--run", str(tmp_path / "run")])
    assert code == 130
    assert outcome(tmp_path / "run") == "interrupted"
    assert "Traceback" not in error


def test_no_second_launcher_enters_while_a_run_is_evaluated(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[bool] = []

    def evaluate(folder: Path, *_: object, **__: object) -> None:
        assert outcome(folder) == "completed"
        with pytest.raises(InUseError), locked(folder):
            pass
        held.append(True)
        raise RunError("seen")

    monkeypatch.setattr(local, "train", complete)
    monkeypatch.setattr(runs, "evaluate", evaluate)
    assert command(["train", "--plain", "--run", str(tmp_path / "run")]) == (1, "apex-bat: seen\n")
    assert held == [True]
    with locked(tmp_path / "run"):
        pass


@pytest.mark.parametrize("is_cut", [False, True])
def test_unfinished_files_go_when_a_run_begins_and_when_it_ends(is_cut: bool, tmp_path: Path) -> None:
    runs.create(tmp_path, Config())
    left = tmp_path / "checkpoints" / f".step-000000001.npz.{os.getpid()}.part"
    left.touch()

    def start(_: object) -> Ended:
        assert not left.exists()
        left.touch()
        return interrupt() if is_cut else complete()

    console = Console(file=io.StringIO())
    if is_cut:
        with pytest.raises(KeyboardInterrupt):
            following.follow(start, tmp_path, "", console, plain=True)
    else:
        following.follow(start, tmp_path, "", console, plain=True)
    assert not left.exists()


def test_a_disk_that_is_too_small_is_told_and_no_reason_not_to_start(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1e6))
    monkeypatch.setattr(local, "train", interrupt)
    command(["train", "--plain", "--run", str(tmp_path / "run")])
    assert [record.message for record in caplog.records if "GB free" in record.message]
    assert outcome(tmp_path / "run") == "interrupted", "it was started"
