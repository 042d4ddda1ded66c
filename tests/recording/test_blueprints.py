"""The layouts show entities that exist, and every one that is documented."""

from __future__ import annotations

from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from apex_bat.recording.blueprints import BLUEPRINTS, flight_blueprint, list_recordings, pair_blueprint, save_blueprints
from apex_bat.recording.series import SERIES
from apex_bat.recording.viewing import PAIR_APPLICATION_ID, save_layout
from apex_bat.simulation.layout import Arena

DOCUMENT = Path(__file__).parents[2] / "docs" / "recordings.md"


def test_three_layouts_are_saved_for_the_application(tmp_path: Path, room: Arena) -> None:
    paths = save_blueprints(tmp_path / "new", room)
    assert [path.name for path in paths] == ["flight.rbl", "ear.rbl", "policy.rbl"]
    for path in paths:
        (store,) = RrdReader(path).blueprints()
        assert store.application_id == "apex_bat"


def test_views_show_what_the_recording_has(recording: Path, room: Arena, tmp_path: Path) -> None:
    existing = _paths(recording)
    for path in save_blueprints(tmp_path, room):
        for origin in _origins(path):
            assert any(entity == origin or entity.startswith(f"{origin}/") for entity in existing), (path.name, origin)


def test_every_layout_has_views() -> None:
    assert set(BLUEPRINTS) == {"flight", "ear", "policy"}


@pytest.mark.parametrize("view", ["flight", "ear", "policy"])
def test_each_flight_of_a_pair_is_shown_from_its_own_entities(
    view: str, recording: Path, room: Arena, tmp_path: Path
) -> None:
    path = save_layout(pair_blueprint(room, ("one", "other"), view), PAIR_APPLICATION_ID, tmp_path)
    existing = _paths(recording)
    origins = _origins(path)
    assert {origin.partition("/")[0] for origin in origins} == {"a", "b"}
    for origin in origins:
        below = origin.partition("/")[2]
        assert any(entity == below or entity.startswith(f"{below}/") for entity in existing), origin


def test_layout_of_several_recordings_lists_them(room: Arena) -> None:
    assert flight_blueprint(room).blueprint_panel.state == "collapsed"
    assert list_recordings(flight_blueprint(room)).blueprint_panel.state == "expanded"


def test_document_lists_every_entity_that_is_written(recording: Path) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for entity in _paths(recording) - {"__properties"}:
        documented = entity.replace("/left/", "/{left,right}/").replace("/right/", "/{left,right}/")
        assert f"`{documented}`" in text, entity
    for series in SERIES:
        assert f"`{series.path}`" in text


def _paths(path: Path) -> set[str]:
    return {chunk.entity_path.removeprefix("/") for chunk in RrdReader(path).stream().to_chunks()}


def _origins(path: Path) -> list[str]:
    """The origins of all views in a saved layout, but for the root."""
    origins = []
    reader = RrdReader(path)
    for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks():
        batch = chunk.to_record_batch()
        if "ViewBlueprint:space_origin" in batch.schema.names:
            origins += [origin.strip("/") for (origin,) in batch.column("ViewBlueprint:space_origin").to_pylist()]
    assert origins
    return [origin for origin in origins if origin]
