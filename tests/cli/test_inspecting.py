"""`apex-bat inspect`: what it lists, writes and opens."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pyarrow import parquet  # type: ignore[import-untyped]
from rerun.blueprint import Blueprint

from apex_bat import config as configuration
from apex_bat.agent.inference import PolicyValues
from apex_bat.cli import main
from apex_bat.config import load
from apex_bat.evaluation.flights import fly
from apex_bat.experience import States
from apex_bat.recording import blueprints, screenshots, viewing
from apex_bat.recording.keeping import keep_flights
from apex_bat.simulation.layout import Arena


def straight_on(states: States) -> PolicyValues:
    """A policy that never turns."""
    q = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(states.echoes), 1))
    return PolicyValues(q, q[:, :1], q)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with two short recorded flights, which both crash."""
    folder = tmp_path_factory.mktemp("runs") / "straight"
    (folder / "figures").mkdir(parents=True)
    config = load(None, ["sonar.rendering=exact", "episode.evaluation_steps=60", "recording.heavy_period_steps=20"])
    (folder / "config.toml").write_text(configuration.dumps(config))
    _, flights = fly(straight_on, config, "simple", num_flights=2, seed=4, num_recorded=2)
    keep_flights(flights, config, folder, num_first=2, draw=False)
    return folder


def inspect(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["apex-bat", "inspect", *map(str, arguments)])
    return main()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], bool]]:
    """Instead of viewers: the recordings and layouts that they would show, and whether in the browser."""
    calls: list[tuple[list[str], bool]] = []

    def open_viewer(paths: list[Path], layout: Path, *, web: bool) -> int:
        assert all(path.exists() for path in (*paths, layout))
        calls.append(([path.name for path in paths], web))
        return 0

    monkeypatch.setattr(viewing, "open_viewer", open_viewer)
    return calls


def test_list_has_a_line_a_flight(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert inspect(monkeypatch, run, "--list") == 0
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split()[:6] == ["flight", "arena", "condition", "steps", "return", "end"]
    assert [line.split()[0] for line in lines] == ["0", "1"]
    assert all("contact" in line and line.rstrip().endswith(".rrd") for line in lines)


def test_best_flight_is_drawn_and_exported(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outputs: list[str | Path] = [
        "--png",
        tmp_path / "a.png",
        "--csv",
        tmp_path / "a.csv",
        "--parquet",
        tmp_path / "a.parquet",
    ]
    assert inspect(monkeypatch, run, *outputs) == 0
    assert Image.open(tmp_path / "a.png").size[0] > 1000
    table = parquet.read_table(tmp_path / "a.parquet")
    assert set(table["action"].to_pylist()) == {"straight"}
    assert len((tmp_path / "a.csv").read_text().splitlines()) == table.num_rows + 1


def test_all_flights_or_one_are_opened(
    run: Path, monkeypatch: pytest.MonkeyPatch, opened: list[tuple[list[str], bool]]
) -> None:
    assert inspect(monkeypatch, run) == 0
    assert inspect(monkeypatch, run, "--flight", "worst", "--view", "ear", "--web") == 0
    (every, in_browser), (one, in_browser_then) = opened
    assert (len(every), in_browser) == (2, False)
    assert one[0].endswith("-worst.rrd")
    assert in_browser_then


def test_two_runs_are_opened_as_one_recording(
    run: Path, monkeypatch: pytest.MonkeyPatch, opened: list[tuple[list[str], bool]]
) -> None:
    assert inspect(monkeypatch, run, run, "--flight", "1") == 0
    assert opened == [(["pair.rrd"], False)]


@pytest.mark.parametrize("view", ["ear", "policy"])
def test_two_runs_have_each_layout(
    view: str, run: Path, monkeypatch: pytest.MonkeyPatch, opened: list[tuple[list[str], bool]]
) -> None:
    views: list[str] = []
    make = blueprints.pair_blueprint

    def note(arena: Arena, names: tuple[str, str], view: str) -> Blueprint:
        views.append(view)
        return make(arena, names, view)

    monkeypatch.setattr(blueprints, "pair_blueprint", note)
    assert inspect(monkeypatch, run, run, "--view", view) == 0
    assert views == [view]
    assert len(opened) == 1


def test_screenshot_is_of_the_layout_at_the_step(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shots: list[tuple[list[str], Path, float | None]] = []

    def take(paths: list[Path], picture: Path, at: float | None) -> list[str]:
        shots.append(([path.suffix for path in paths], picture, at))
        return []

    monkeypatch.setattr(screenshots, "take_screenshot", take)
    assert inspect(monkeypatch, run, "--flight", "0", "--screenshot", tmp_path / "a.png", "--at", "7") == 0
    assert shots == [([".rrd", ".rbl"], tmp_path / "a.png", 7.0)]


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--flight", "7"], 1, "there is no flight 7; the last is 1"),
        (["--condition", "onset"], 1, "no flights under the condition 'onset'"),
        (["--view", "training"], 1, "the training was not recorded"),
        (["--view", "nothing"], 2, "nothing"),
    ],
)
def test_what_is_not_there_is_one_line(
    run: Path,
    arguments: list[str],
    code: int,
    says: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert inspect(monkeypatch, run, *arguments) == code
    assert says in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--list"], ["--view", "training"], ["--png", "a.png"]])
def test_what_two_runs_do_not_have_together_is_refused(
    run: Path, arguments: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert inspect(monkeypatch, run, run, *arguments) == 2
