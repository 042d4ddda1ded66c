"""Opening recordings: on loopback, whole ones, laid out, two in one."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from rerun.chunk import RrdReader

from apex_bat.recording import viewing
from apex_bat.recording.blueprints import APPLICATION_ID, flight_blueprint, pair_blueprint
from apex_bat.recording.flight import Flight
from apex_bat.recording.reading import is_whole, read_flight
from apex_bat.recording.viewing import PAIR_APPLICATION_ID, open_viewer, save_layout, whole_copies, write_pair
from apex_bat.simulation.layout import Arena


class Viewer:
    """Instead of a viewer: notes how it was started, and ends with the code 3."""

    commands: ClassVar[list[list[str]]] = []

    def __init__(self, command: list[str]) -> None:
        self.commands.append(command[command.index("rerun") + 1 :])

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def poll(self) -> int | None:
        return None

    def wait(self) -> int:
        return 3


class Client:
    """Instead of a connection to it: shows whichever recording was read last, as the real one does."""

    is_up = False
    known: ClassVar[list[str]] = []
    to_read: ClassVar[list[str]] = []
    shown = ""

    @classmethod
    def connect(cls, url: str) -> type[Client]:
        assert url == f"rerun+http://127.0.0.1:{Viewer.commands[-1][-1]}/proxy"
        if not cls.is_up:
            cls.is_up, cls.to_read = True, [Viewer.commands[-1][0]]
            raise ConnectionError("not up yet")
        return cls

    @classmethod
    def get_state(cls) -> SimpleNamespace:
        if cls.to_read:
            cls.shown = cls.to_read.pop()
            cls.known.append(cls.shown)
        found = [SimpleNamespace(store_id=name, location=name) for name in cls.known]
        return SimpleNamespace(recordings=found, loading=list(cls.to_read), active_recording=cls.shown)

    @classmethod
    def open(cls, urls: list[str], *, navigate: bool) -> None:
        assert not navigate
        cls.to_read = [Path(url).name for url in urls]

    @classmethod
    def set_location(cls, location: str) -> None:
        assert not cls.to_read
        cls.shown = location


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The arguments of the viewers that were started."""
    monkeypatch.setattr(Viewer, "commands", [])
    for name, value in (("is_up", False), ("known", []), ("to_read", []), ("shown", "")):
        monkeypatch.setattr(Client, name, value)
    monkeypatch.setattr(subprocess, "Popen", Viewer)
    monkeypatch.setattr(viewing, "ViewerClient", Client)
    monkeypatch.setattr(viewing, "_POLL_S", 0.0)
    return Viewer.commands


def test_viewer_listens_on_this_machine_only_and_the_layout_comes_last(started: list[list[str]]) -> None:
    assert open_viewer([Path("a.rrd")], Path("ear.rbl"), web=False) == 3
    assert open_viewer([Path("a.rrd"), Path("b.rrd")], Path("ear.rbl"), web=True) == 3
    native, web = started
    assert native[:5] == ["a.rrd", "ear.rbl", "--bind", "127.0.0.1", "--port"]
    assert web[:5] == ["a.rrd", "b.rrd", "ear.rbl", "--bind", "127.0.0.1"]
    assert "--web-viewer" in web
    assert not Client.is_up


def test_the_last_recording_comes_first_with_the_layout_and_is_shown_at_the_end(started: list[list[str]]) -> None:
    assert open_viewer([Path("c.rrd"), Path("b.rrd"), Path("a.rrd")], Path("ear.rbl"), web=False) == 3
    assert started[0][:3] == ["a.rrd", "ear.rbl", "--bind"]
    assert sorted(Client.known) == ["a.rrd", "b.rrd", "c.rrd"]
    assert Client.shown == "a.rrd"


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
