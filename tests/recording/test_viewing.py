"""Opening recordings: on loopback, whole ones, laid out, two in one."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from apex_bat.recording.blueprints import APPLICATION_ID, flight_blueprint, pair_blueprint
from apex_bat.recording.flight import Flight
from apex_bat.recording.reading import is_whole, read_flight
from apex_bat.recording.viewing import PAIR_APPLICATION_ID, open_viewer, save_layout, whole_copies, write_pair
from apex_bat.simulation.layout import Arena


def test_viewer_listens_on_this_machine_only_and_the_layout_comes_last(monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def run(command: list[str], *, check: bool) -> SimpleNamespace:
        assert not check
        commands.append(command)
        return SimpleNamespace(returncode=3)

    monkeypatch.setattr(subprocess, "run", run)
    assert open_viewer([Path("a.rrd"), Path("b.rrd")], Path("ear.rbl"), web=False) == 3
    assert open_viewer([Path("a.rrd")], Path("ear.rbl"), web=True) == 3
    native, web = (command[command.index("rerun") + 1 :] for command in commands)
    assert native == ["a.rrd", "b.rrd", "ear.rbl", "--bind", "127.0.0.1", "--port", "auto"]
    assert web[:4] == ["a.rrd", "ear.rbl", "--bind", "127.0.0.1"]
    assert "--web-viewer" in web


def test_only_what_was_cut_short_is_repaired(recording: Path, flight: Flight, tmp_path: Path) -> None:
    cut = tmp_path / "cut.rrd.part"
    cut.write_bytes(recording.read_bytes()[:-100])
    assert not is_whole(cut)
    whole, repaired = whole_copies([recording, cut], tmp_path)
    assert whole == recording
    assert is_whole(repaired)
    assert read_flight(repaired).num_steps == flight.num_steps


def test_pair_holds_both_flights_below_their_letters(recording: Path, tmp_path: Path) -> None:
    write_pair(recording, recording, tmp_path / "pair.rrd")
    reader = RrdReader(tmp_path / "pair.rrd")
    assert reader.recordings()[0].application_id == PAIR_APPLICATION_ID
    chunks = reader.stream().to_chunks()
    single = {chunk.entity_path for chunk in RrdReader(recording).stream().to_chunks()}
    expected = {f"/{letter}{path}" for letter in "ab" for path in single if not path.startswith("/__properties")}
    assert {chunk.entity_path for chunk in chunks} >= expected
    values = [_values(chunks, f"/{letter}/policy/value") for letter in "ab"]
    np.testing.assert_array_equal(values[0], values[1])
    np.testing.assert_array_equal(values[0], read_flight(recording).value)


def test_layouts_belong_to_their_applications(room: Arena, tmp_path: Path) -> None:
    for blueprint, application_id in (
        (flight_blueprint(room), APPLICATION_ID),
        (pair_blueprint(room, ("one", "other")), PAIR_APPLICATION_ID),
    ):
        path = save_layout(blueprint, application_id, tmp_path)
        assert [store.application_id for store in RrdReader(path).blueprints()] == [application_id]


def _values(chunks: list[Any], entity: str) -> list[float]:
    rows: list[tuple[int, float]] = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and "Scalars:scalars" in batch.schema.names:
            scalars = batch.column("Scalars:scalars").flatten().to_pylist()
            rows += zip(batch.column("step").to_pylist(), scalars, strict=True)
    return [value for _, value in sorted(rows)]
