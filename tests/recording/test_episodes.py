"""Every entity of a recording, read back with rerun alone, is what the flight was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from rerun.chunk import RrdReader

from apex_bat.config import settings
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.flight import ACTION_NAMES, Flight
from apex_bat.recording.hearing import Directions, level_colours
from apex_bat.recording.series import RED, SERIES
from apex_bat.recording.spectrogram import cochleagrams
from apex_bat.recording.stages import STAGES
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.sonar import Sonar


def test_scalars_stand_at_their_steps(recording: Path, flight: Flight) -> None:
    for series in SERIES:
        steps, rows = _entity(recording, series.path, "Scalars:scalars")
        expected = getattr(flight, series.field)
        first = 1 if series.when == "result" else 0
        assert steps == list(range(first, first + len(expected))), series.path
        np.testing.assert_array_equal(np.array(rows), expected.reshape(len(expected), -1), err_msg=series.path)


def test_both_timelines_agree(recording: Path) -> None:
    steps, _ = _entity(recording, "policy/value", "Scalars:scalars")
    _, times = _entity(recording, "policy/value", "sim_time")
    assert [time.total_seconds() for time in times] == pytest.approx([step * 0.05 for step in steps])


def test_bat_stands_where_it_was(recording: Path, flight: Flight) -> None:
    steps, places = _entity(recording, "world/bat", "Transform3D:translation")
    _, turns = _entity(recording, "world/bat", "Transform3D:quaternion")
    assert steps == list(range(flight.num_steps + 1))
    place, turn = np.array(places)[:, 0], np.array(turns)[:, 0]
    np.testing.assert_allclose(place[:, :2], flight.poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(place[:, 2], flight.facts.body.sensor_height_m, atol=1e-6)
    heading_rad = 2.0 * np.arctan2(turn[:, 2], turn[:, 3])
    np.testing.assert_allclose(np.exp(1j * heading_rad), np.exp(1j * flight.poses[:, 2]), atol=1e-6)


def test_trail_joins_the_poses_and_shows_where_it_was_near(recording: Path, flight: Flight) -> None:
    steps, pieces = _entity(recording, "world/trajectory", "LineStrips3D:strips")
    _, colours = _entity(recording, "world/trajectory", "LineStrips3D:colors")
    assert steps == list(range(1, flight.num_steps + 1))
    piece = np.array(pieces)[:, 0, :, :2]
    np.testing.assert_allclose(piece[:, 0], flight.poses[:-1, :2], atol=1e-6)
    np.testing.assert_allclose(piece[:, 1], flight.poses[1:, :2], atol=1e-6)
    is_near = np.array(colours)[:, 0] == int.from_bytes([*RED, 255], "big")
    np.testing.assert_array_equal(is_near, flight.reward_near != 0)


def test_contact_is_marked_where_it_happened(recording: Path, flight: Flight) -> None:
    steps, places = _entity(recording, "world/contacts", "Points3D:positions")
    assert steps == [flight.num_steps]
    np.testing.assert_allclose(places[0][0][:2], flight.poses[-1, :2], atol=1e-6)


def test_actions_are_named(recording: Path, flight: Flight) -> None:
    steps, names = _entity(recording, "policy/action", "StateChange:state")
    assert steps == list(range(flight.num_steps))
    assert [name for (name,) in names] == [ACTION_NAMES[action] for action in flight.action]


def test_frames_and_states_are_those_of_the_flight(recording: Path, flight: Flight) -> None:
    for number, ear in enumerate(("left", "right")):
        _, bars = _entity(recording, f"echo/{ear}/frame", "BarChart:values")
        np.testing.assert_array_equal([bar[0]["buffer"] for bar in bars], flight.frame[:, number])
    _, images = _entity(recording, "policy/state", "DepthImage:buffer")
    for image, state in zip(images, flight.state, strict=True):
        np.testing.assert_array_equal(np.array(image[0], np.uint8).view(np.float32).reshape(state.shape), state)


def test_stages_of_the_ear_are_those_of_the_sonar(recording: Path, flight: Flight, directions: Directions) -> None:
    assert flight.ranges_m is not None
    echo = Sonar(rendering="thesis").hear(*directions, flight.ranges_m[3])
    for stage in STAGES:
        values = getattr(echo, stage.field)[:, :: stage.every]
        for number, ear in enumerate(("left", "right")):
            steps, bars = _entity(recording, f"echo/{ear}/{stage.name}", "BarChart:values")
            assert steps == flight.heavy_steps.tolist()
            np.testing.assert_allclose(bars[3][0]["buffer"], values[number], rtol=1e-3, atol=1e-7, err_msg=stage.name)
        _, spans = _entity(recording, f"echo/scale/{stage.name}", "BarChart:values")
        highest, lowest = max(0.0, values.max()), min(0.0, values.min())
        np.testing.assert_allclose(spans[3][0]["buffer"], [highest, lowest], rtol=1e-3, err_msg=stage.name)


def test_cochleagrams_have_the_highest_frequency_on_top(
    recording: Path, flight: Flight, directions: Directions
) -> None:
    assert flight.ranges_m is not None
    pressure_pa = Sonar(rendering="thesis").hear(*directions, flight.ranges_m[3]).pressure_pa
    assert pressure_pa is not None
    heard = cochleagrams(pressure_pa, 125_000)
    for number, ear in enumerate(("left", "right")):
        _, images = _entity(recording, f"echo/{ear}/cochleagram", "DepthImage:buffer")
        upside = np.array(images[3][0], np.uint8).view(np.float16).reshape(heard.shape[1:])
        np.testing.assert_allclose(upside[::-1], heard[number], rtol=1e-3, atol=1e-7)


def test_frames_of_both_ears_share_a_scale(recording: Path, flight: Flight) -> None:
    _, spans = _entity(recording, "echo/scale/frame", "BarChart:values")
    np.testing.assert_array_equal([span[0]["buffer"][0] for span in spans], flight.frame.max(axis=(1, 2)))


def test_points_are_where_the_rays_hit_and_coloured_by_level(
    recording: Path, flight: Flight, directions: Directions
) -> None:
    assert flight.ranges_m is not None
    _, places = _entity(recording, "world/bat/points", "Points3D:positions")
    ranges_m = flight.ranges_m[2]
    is_hit = np.isfinite(ranges_m)
    place = np.array(places[2])
    np.testing.assert_allclose(np.linalg.norm(place, axis=1), ranges_m[is_hit], rtol=1e-5)
    np.testing.assert_allclose(np.arctan2(place[:, 1], place[:, 0]), directions.azimuth_rad[is_hit], atol=1e-5)
    level_db = Sonar().hear(*directions, ranges_m).level_db[:, is_hit]
    for component, level in [
        ("Points3D:colors", level_db.max(axis=0)),
        ("left_colors", level_db[0]),
        ("right_colors", level_db[1]),
    ]:
        _, colours = _entity(recording, "world/bat/points", component)
        assert colours[2] == level_colours(level).tolist(), component


def test_ranges_are_kept_bit_for_bit(recording: Path, flight: Flight) -> None:
    _, tensors = _entity(recording, "sensor/ranges", "Tensor:data")
    np.testing.assert_array_equal([tensor[0]["buffer"] for tensor in tensors], flight.ranges_m)


def test_events_tell_the_story(recording: Path, flight: Flight) -> None:
    steps, lines = _entity(recording, "events", "TextLog:text")
    texts = [line for (line,) in lines]
    assert steps == [0, 101, flight.num_steps, flight.num_steps]
    assert texts[0].startswith("step 0: start in room")
    assert texts[1].startswith("step 101: near a wall")
    assert texts[2:] == [f"step {flight.num_steps}: contact", f"step {flight.num_steps}: end: contact"]


def test_properties_describe_the_flight(recording: Path) -> None:
    batch = next(
        chunk.to_record_batch()
        for chunk in RrdReader(recording).stream().to_chunks()
        if chunk.entity_path == "/__properties/flight"
    )
    known = {name: value[0] for name, value in batch.to_pylist()[0].items() if isinstance(value, list)}
    assert known["arena"] == "room"
    assert known["actor"] == 4
    assert known["collided"] is True
    assert known["steps"] == 130
    assert "checkpoint_step" not in known
    assert "mark" not in known
    assert (known["start_x_m"], known["start_y_m"], known["start_heading_rad"]) == (-1.5, 0.0, 0.0)


def test_recording_has_its_own_id_a_shared_application_and_a_layout(
    fly: Callable[..., Flight], recording: Path, room: Arena, directions: Directions, tmp_path: Path
) -> None:
    write_flight(fly(3), room, settings.Sonar(), directions, tmp_path / "other.rrd")
    one, other = (RrdReader(path).recordings()[0] for path in (recording, tmp_path / "other.rrd"))
    assert one.recording_id != other.recording_id
    assert one.application_id == other.application_id == "apex_bat"
    assert RrdReader(recording).blueprints()


def test_flight_without_ranges_is_recorded_without_the_ear(
    fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path: Path
) -> None:
    path = tmp_path / "light.rrd"
    write_flight(fly(5, num_points=0), room, settings.Sonar(), directions, path)
    assert _entity(path, "echo/left/waveform", "BarChart:values") == ([], [])
    assert len(_entity(path, "policy/q", "Scalars:scalars")[1]) == 5


def test_a_step_costs_a_bounded_number_of_bytes(
    fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path: Path
) -> None:
    sizes = []
    for num_steps in (100, 300):
        path = tmp_path / f"{num_steps}.rrd"
        write_flight(fly(num_steps, num_points=0), room, settings.Sonar(), directions, path)
        sizes.append(path.stat().st_size)
    assert (sizes[1] - sizes[0]) / 200 < 2_200  # random states and frames, which do not compress: 768 bytes of them
    assert sizes[0] < 500_000


def test_wrong_directions_are_refused(flight: Flight, room: Arena, directions: Directions, tmp_path: Path) -> None:
    fewer = Directions(directions.azimuth_rad[:7], directions.elevation_rad[:7])
    with pytest.raises(ValueError, match="30 rays and there are 7"):
        write_flight(flight, room, settings.Sonar(), fewer, tmp_path / "x.rrd")
    assert not list(tmp_path.iterdir())


def test_missing_folder_is_an_os_error_that_names_the_file(
    fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path: Path
) -> None:
    with pytest.raises(OSError, match=r"x\.rrd"):
        write_flight(fly(2), room, settings.Sonar(), directions, tmp_path / "nowhere" / "x.rrd")


def test_a_recording_leaves_no_thread_behind(
    fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path: Path
) -> None:
    process, threads = psutil.Process(), []
    for number in range(6):
        write_flight(fly(2), room, settings.Sonar(), directions, tmp_path / f"{number}.rrd")
        threads.append(process.num_threads())
    assert threads[-1] <= threads[0], threads


def _entity(path: Path, entity: str, component: str) -> tuple[list[int], list[Any]]:
    """Steps and values of a component, in the order of the steps."""
    rows: list[tuple[int, Any]] = []
    for chunk in RrdReader(path).stream().to_chunks():
        if chunk.entity_path == f"/{entity}" and not chunk.is_static:
            batch = chunk.to_record_batch()
            if component in batch.schema.names:
                rows += zip(batch.column("step").to_pylist(), batch.column(component).to_pylist(), strict=True)
    rows.sort(key=lambda row: row[0])
    return [step for step, _ in rows], [value for _, value in rows]
