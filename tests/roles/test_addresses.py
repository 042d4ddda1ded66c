"""Where the roles of a run find one another, and who else does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Event

import msgspec
import pytest

from apex_bat.config import Config
from apex_bat.launching import local
from apex_bat.roles.actor import run_actor
from apex_bat.roles.evaluator import run_evaluator
from apex_bat.roles.learner import run_learner
from apex_bat.roles.plan import Addresses, Assignment, Role, read_addresses
from apex_bat.roles.process import run_process
from apex_bat.roles.replay import run_replay
from apex_bat.storage import StorageError
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import TransportError

OPEN = Addresses(*(f"tcp://192.0.2.1:{port}" for port in (5001, 5002, 5003)))
RUNNERS: dict[str, Callable[[Assignment], None]] = {
    "actor": run_actor, "learner": run_learner, "replay": run_replay, "evaluator": run_evaluator,
}  # fmt: skip


@pytest.mark.parametrize("kind", sorted(RUNNERS))
def test_no_role_starts_on_an_open_address_without_keys(tmp_path: Path, kind: str) -> None:
    assignment = Assignment(Role(kind, 0), Config(), tmp_path, OPEN, Event(), 0)  # type: ignore[arg-type]
    with pytest.raises(TransportError, match=r"not a loopback address, so it needs CURVE keys.*apex-bat keys"):
        RUNNERS[kind](assignment)


def test_the_launcher_does_not_start_on_an_open_address_without_keys(tmp_path: Path) -> None:
    config = msgspec.structs.replace(Config(), transport=msgspec.structs.replace(Config().transport, host="0.0.0.0"))  # noqa: S104
    with pytest.raises(TransportError, match="needs CURVE keys"), local._addresses(config, tmp_path) as addresses:
        ReportCollector(addresses.reports)


@pytest.mark.parametrize("host", ["ipc", "127.0.0.1"])
def test_each_start_draws_generations_that_differ_for_each_socket(tmp_path: Path, host: str) -> None:
    config = msgspec.structs.replace(Config(), transport=msgspec.structs.replace(Config().transport, host=host))
    drawn = set()
    for _ in range(2):
        with local._addresses(config, tmp_path) as found:
            drawn |= {found.replay_generation, found.weights_generation, found.reports_generation}
    assert len(drawn) == 6
    assert max(drawn) > 2**50


def test_a_host_that_is_not_here_is_one_clear_line(tmp_path: Path) -> None:
    config = msgspec.structs.replace(Config(), transport=msgspec.structs.replace(Config().transport, host="192.0.2.1"))
    with (
        pytest.raises(TransportError, match=r"transport\.host=192\.0\.2\.1: cannot listen there"),
        local._addresses(config, tmp_path),
    ):
        pass


@pytest.mark.parametrize("text", ["", "{", "[]", '{"replay": 3}', '{"replay": "a", "weights": "b"}'])
def test_damaged_addresses_are_told_in_one_line_and_not_tried_again(
    tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "addresses.json").write_text(text)
    with pytest.raises(StorageError, match=r"torn or corrupted|no JSON object"):
        read_addresses(tmp_path / "addresses.json")
    (tmp_path / "config.toml").write_text("")
    assert run_process("actor", 0, tmp_path, 0, leashed=False) == 2
    assert "addresses.json" in caplog.text
