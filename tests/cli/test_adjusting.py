"""Changing a run's law while it goes on: with several servers, what became of each is said and noted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from apex_bat.replay import adjusting
from apex_bat.roles.plan import Addresses
from apex_bat.transport.messages import Ratio, RatioChange
from apex_bat.transport.security import TransportError
from tests.cli.conftest import Command

Answer = Callable[[str, RatioChange], Ratio]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run with three replay servers."""
    addresses = Addresses("a", "w", "r", further_replays=(("b", 2), ("c", 3)))
    (tmp_path / "addresses.json").write_bytes(msgspec.json.encode(addresses))
    (tmp_path / "config.toml").write_text("replay.shards = 3\n")
    (tmp_path / "run.json").write_text("{}")
    return tmp_path


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Callable[[Answer], list[str]]:
    """Lets servers answer by a function; returns the addresses of those that were asked, as it grows."""

    def answer_by(answer: Answer) -> list[str]:
        addresses: list[str] = []

        def change_ratio(address: str, change: RatioChange, **_: object) -> Ratio:
            addresses.append(address)
            return answer(address, change)

        monkeypatch.setattr(adjusting, "change_ratio", change_ratio)
        return addresses

    return answer_by


def noted(run: Path) -> list[dict[str, object]]:
    entries: list[dict[str, object]] = json.loads((run / "run.json").read_text()).get("adjusted", [])
    return entries


def changed(_: str, change: RatioChange) -> Ratio:
    assert change.error_buffer is not None
    return Ratio(change.samples_per_insert, change.error_buffer, "")


def test_the_band_is_shared_out_over_the_servers_and_noted_as_a_whole(
    run: Path, command: Command, asked: Callable[[Answer], list[str]]
) -> None:
    addresses = asked(changed)
    assert command(["adjust", str(run), "--samples-per-insert", "4", "--error-buffer", "9000"]) == (0, "")
    assert addresses == ["a", "b", "c"]
    [entry] = noted(run)
    assert (entry["samples_per_insert"], entry["error_buffer"]) == (4.0, 9000.0)
    assert "servers" not in entry


@pytest.mark.parametrize(
    ("error", "code"), [(TransportError("no answer within 10 s"), 1), (ValueError("too narrow"), 2)]
)
def test_which_servers_were_changed_before_one_failed_is_said_and_noted(
    run: Path, command: Command, asked: Callable[[Answer], list[str]], error: Exception, code: int
) -> None:
    def answer(address: str, change: RatioChange) -> Ratio:
        if address == "c":
            raise error
        return changed(address, change)

    asked(answer)
    result, says = command(["adjust", str(run), "--samples-per-insert", "4", "--error-buffer", "9000"])
    assert result == code
    assert f"replay-2: {error}" in says
    assert "replay-0, replay-1 have the new law" in says
    [entry] = noted(run)
    assert (entry["samples_per_insert"], entry["error_buffer"]) == (4.0, 9000.0)
    assert entry["servers"] == ["replay-0", "replay-1"]


def test_nothing_is_noted_when_the_first_server_fails(
    run: Path, command: Command, asked: Callable[[Answer], list[str]]
) -> None:
    def answer(_: str, __: RatioChange) -> Ratio:
        raise ValueError("too narrow")

    assert len(asked(answer)) == 0
    result, says = command(["adjust", str(run), "--samples-per-insert", "4"])
    assert (result, "too narrow" in says, "have the new law" in says) == (2, True, False)
    assert noted(run) == []
