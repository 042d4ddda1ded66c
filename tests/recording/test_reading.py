"""A flight read back is the flight that was written, also from files that were cut short."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from apex_bat.config import settings
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.flight import Flight
from apex_bat.recording.hearing import Directions
from apex_bat.recording.probing import undecodable
from apex_bat.recording.reading import RecordingError, read_flight, read_settings
from apex_bat.simulation.layout import Arena


def test_flight_comes_back_bit_for_bit(recording: Path, flight: Flight) -> None:
    _assert_equal(read_flight(recording), flight)


def test_flight_without_ranges_and_contacts_comes_back(
    fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path: Path
) -> None:
    flight = fly(4, num_points=0)
    flight.contact[:] = False
    write_flight(flight, room, settings.Sonar(), directions, tmp_path / "a.rrd")
    _assert_equal(read_flight(tmp_path / "a.rrd"), flight)


def test_settings_come_back(recording: Path, room: Arena) -> None:
    known = read_settings(recording)
    assert known.arena == room
    assert known.sonar == settings.Sonar(rendering="exact")
    assert known.body == settings.Body()


def test_file_cut_short_gives_its_whole_steps_as_a_broken_off_flight(
    fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path: Path
) -> None:
    flight, cut = fly(400), tmp_path / "cut.rrd"
    write_flight(flight, room, settings.Sonar(), directions, cut)
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    part = read_flight(cut)
    assert 0 < part.num_steps < flight.num_steps
    assert part.end == ""
    np.testing.assert_array_equal(part.poses, flight.poses[: part.num_steps + 1])
    np.testing.assert_array_equal(part.frame, flight.frame[: part.num_steps])
    assert part.ranges_m is not None
    assert len(part.ranges_m) == len(part.heavy_steps) == -(-part.num_steps // 5)


def test_file_without_its_index_gives_the_whole_flight(recording: Path, flight: Flight, tmp_path: Path) -> None:
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(recording.read_bytes()[:-100])
    assert read_flight(cut).num_steps == flight.num_steps


@pytest.mark.parametrize("content", [b"", b"no recording at all" * 50])
def test_other_files_are_refused_by_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "odd.rrd"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"odd\.rrd"):
        read_flight(path)


def test_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such recording"):
        read_flight(tmp_path / "none.rrd")


def _assert_equal(one: Flight, other: Flight) -> None:
    for field in fields(Flight):
        left, right = getattr(one, field.name), getattr(other, field.name)
        if isinstance(right, np.ndarray):
            assert left.dtype == right.dtype, field.name
            np.testing.assert_array_equal(left, right, err_msg=field.name)
        else:
            assert left == right, field.name


def test_a_zero_in_the_name_of_a_column_ends_another_process_and_not_this_one(tmp_path: Path) -> None:
    path = tmp_path / "flight.rrd"
    recording = rr.RecordingStream("damaged")
    recording.save(path)
    named: dict[str, Any] = {"labels\0\0colors": [1.0]}
    recording.log("policy/q", rr.AnyValues(**named))
    recording.flush()
    recording.disconnect()
    assert undecodable([path]) == [path]
    with pytest.raises(RecordingError, match=r"flight\.rrd"):
        read_flight(path)
