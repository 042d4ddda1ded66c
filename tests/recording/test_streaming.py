"""A run is streamed to a viewer when there is one, and never held up by one."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import rerun as rr

from apex_bat import config as configuration
from apex_bat.config import Config, settings
from apex_bat.recording import streaming
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.flight import Flight
from apex_bat.recording.hearing import Directions
from apex_bat.recording.streaming import RunStream, stream_run, streamer
from apex_bat.simulation.layout import Arena


@pytest.fixture
def run(fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path: Path) -> Path:
    """A run with a row of metrics and a recorded evaluation flight."""
    for name in ("metrics", "recordings", "logs"):
        (tmp_path / name).mkdir()
    (tmp_path / "config.toml").write_text(configuration.dumps(Config()))
    (tmp_path / "run.json").write_text(json.dumps({"outcome": "running"}))
    add_row(tmp_path, 1)
    flight = fly(4, num_points=0)
    flight = replace(flight, facts=replace(flight.facts, kind="evaluation"))
    write_flight(flight, room, settings.Sonar(), directions, tmp_path / "recordings" / flight.facts.file_name())
    return tmp_path


def add_row(run: Path, second: int) -> None:
    row = {"unix_s": second, "elapsed_s": second, "role": "learner", "pid": 1, "state": "", "env_steps_total": second,
           "learner_step_total": second, "loss": 1.0}  # fmt: skip
    with (run / "metrics" / "learner.jsonl").open("a") as file:
        file.write(json.dumps(row) + "\n")


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
        return port


def noting(taken: list[Any]) -> Callable[..., None]:
    """A method that only notes its first argument."""

    def method(_: rr.RecordingStream, first: object, *__: object, **___: object) -> None:
        taken.append(first)

    return method


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Any]]:
    """A viewer that is always there: what it is sent, by kind."""
    taken: dict[str, list[Any]] = {"connections": [], "columns": [], "chunks": []}
    monkeypatch.setattr(streaming, "_is_listening", lambda port: port == 1)
    for method, kind in (("connect_grpc", "connections"), ("send_columns", "columns"), ("send_chunks", "chunks")):
        monkeypatch.setattr(rr.RecordingStream, method, noting(taken[kind]))
    return taken


def test_without_a_viewer_nothing_is_sent(run: Path, sent: dict[str, list[Any]]) -> None:
    stream = RunStream(run, 2)
    stream.step()
    assert not stream.is_connected
    assert sent == {"connections": [], "columns": [], "chunks": []}


def test_each_row_and_each_flight_is_sent_once_to_this_machine(run: Path, sent: dict[str, list[Any]]) -> None:
    stream = RunStream(run, 1)
    stream.step()
    assert sent["connections"] == ["rerun+http://127.0.0.1:1/proxy"] * 2
    assert sent["columns"] == ["learner/loss", "events"]
    assert len(sent["chunks"]) == 1
    stream.step()
    assert len(sent["columns"]) == 2
    add_row(run, 2)
    stream.step()
    assert sent["columns"][2:] == ["learner/loss"]
    assert len(sent["chunks"]) == 1


def test_a_viewer_that_comes_back_gets_everything_again(
    run: Path, sent: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = RunStream(run, 1)
    stream.step()
    with monkeypatch.context() as context:
        context.setattr(streaming, "_is_listening", lambda _: False)
        stream.step()
        assert not stream.is_connected
    stream.step()
    assert sent["columns"] == ["learner/loss", "events"] * 2
    assert len(sent["chunks"]) == 2


def test_stream_of_a_run_that_has_ended_ends_with_what_is_left(run: Path, sent: dict[str, list[Any]]) -> None:
    (run / "run.json").write_text(json.dumps({"outcome": "completed"}))
    assert stream_run(run, 1)
    assert sent["columns"] == ["learner/loss", "events"]


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_a_viewer_that_takes_nothing_is_given_up(run: Path) -> None:
    (run / "run.json").write_text(json.dumps({"outcome": "completed"}))
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        command = [
            sys.executable,
            "-m",
            "apex_bat",
            "inspect",
            str(run),
            "--live",
            "--port",
            str(deaf.getsockname()[1]),
        ]
        assert subprocess.run(command, check=False, timeout=3 * streaming.STEP_TIMEOUT_S).returncode == 0


@pytest.mark.slow
def test_streamer_ends_with_its_block_and_with_its_launcher(run: Path) -> None:
    begin_s = time.monotonic()
    with streamer(run, free_port()):
        pass
    assert time.monotonic() - begin_s < 10.0
    launcher = subprocess.run(
        [sys.executable, "-c", f"from pathlib import Path\nfrom apex_bat.recording.streaming import streamer\n"
         f"with streamer(Path({str(run)!r}), {free_port()}):\n    import os; os._exit(0)"],
        check=False, timeout=60,
    )  # fmt: skip
    assert launcher.returncode == 0
    deadline_s = time.monotonic() + 30.0
    while str(run) in _commands():
        assert time.monotonic() < deadline_s, "the streamer outlives its launcher"
        time.sleep(0.2)


def _commands() -> str:
    if not Path("/proc").is_dir():
        pytest.skip("needs /proc")
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(path.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        except OSError:
            continue
    return "\n".join(lines)
