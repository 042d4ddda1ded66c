"""Running commands in the process of the tests."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from apex_bat.cli import main

Command = Callable[[list[str]], tuple[int, str]]
"""Runs a command and returns its exit code and what it said on standard error."""
Refused = Callable[[list[str], int, str], None]
"""Runs a command that must start nothing: takes its arguments, the exit code and what it says on standard error."""


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs commands."""

    def run(arguments: list[str]) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["apex-bat", *arguments])
        code = main()
        return code, capsys.readouterr().err

    return run


@pytest.fixture
def refused(command: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Refused:
    """Runs commands with wrong arguments, in an empty folder, and checks what becomes of them."""

    def run(arguments: list[str], code: int, says: str) -> None:
        monkeypatch.chdir(tmp_path)
        result, error = command(arguments)
        assert result == code
        assert says in error
        assert "Traceback" not in error
        assert not list(tmp_path.iterdir()), "nothing was started"

    return run
