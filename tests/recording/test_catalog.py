"""Recordings of a run are found, told apart and chosen, those of killed processes too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import settings
from apex_bat.recording.catalog import choose_flight, list_flights, same_start
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.flight import Flight, Mark
from apex_bat.recording.hearing import Directions
from apex_bat.recording.reading import RecordingError
from apex_bat.simulation.layout import Arena


@pytest.fixture(scope="module")
def run(
    fly: Callable[..., Flight], room: Arena, directions: Directions, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run with a good and a crashed evaluation flight, one of training that was cut short, and other files."""
    folder = tmp_path_factory.mktemp("run")
    recordings = folder / "recordings"
    recordings.mkdir()
    crashed = fly(5, num_points=0)
    facts = replace(crashed.facts, kind="evaluation", actor=None, checkpoint_step=70)
    good = replace(crashed, end="time", progress_m=np.full(5, 20.0, np.float32), contact=np.zeros(5, bool))
    marked: list[tuple[Flight, int, Mark]] = [(crashed, 0, "worst"), (good, 1, "")]
    for flight, episode, mark in marked:
        named = replace(flight, facts=replace(facts, episode=episode, mark=mark))
        write_flight(named, room, settings.Sonar(), directions, recordings / named.facts.file_name())
    training = recordings / fly(5).facts.file_name()
    write_flight(fly(5), room, settings.Sonar(), directions, training)
    training.rename(training.with_name(training.name + ".part"))
    part = training.with_name(training.name + ".part")
    part.write_bytes(part.read_bytes()[:-100])
    (recordings / "training.rrd").write_bytes(b"the curves, which are no flight")
    (recordings / "notes.rrd").write_bytes(b"something else")
    return folder


def test_evaluations_come_first_and_other_files_not_at_all(run: Path) -> None:
    entries = list_flights(run)
    assert [(entry.kind, entry.episode, entry.end, entry.mark) for entry in entries] == [
        ("evaluation", 0, "contact", "worst"),
        ("evaluation", 1, "time", ""),
        ("training", 12, "contact", ""),
    ]
    assert entries[0].checkpoint_step == 70
    assert entries[0].start == (-1.5, 0.0, 0.0)
    assert entries[2].path.suffix == ".part"


def test_flights_are_chosen_by_merit_and_number(run: Path) -> None:
    entries = list_flights(run)
    chosen = {which: entries.index(choose_flight(entries, which)) for which in ("best", "worst", "crash", "2")}
    assert chosen == {"best": 1, "worst": 0, "crash": 0, "2": 2}


def test_the_crash_is_the_one_that_flew_longest_before(run: Path) -> None:
    early, _, _ = list_flights(run)
    late = replace(early, steps=early.steps + 1)
    assert choose_flight([early, late, early], "crash") is late


@pytest.mark.parametrize(("which", "says"), [("3", "the last is 2"), ("fastest", "best, worst, crash or a number")])
def test_what_is_not_there_is_refused(run: Path, which: str, says: str) -> None:
    with pytest.raises(RecordingError, match=says):
        choose_flight(list_flights(run), which)


def test_no_crash_is_said(run: Path) -> None:
    with pytest.raises(RecordingError, match="ended at a wall"):
        choose_flight(list_flights(run)[1:2], "crash")


def test_conditions_are_told_apart(run: Path) -> None:
    assert len(list_flights(run, "memory")) == 3
    with pytest.raises(RecordingError, match="there are memory"):
        list_flights(run, "onset")


def test_run_without_recordings_tells_how_to_make_some(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"evaluate .* --record 3"):
        list_flights(tmp_path)


def test_the_same_start_is_found_by_its_pose(run: Path) -> None:
    entries = list_flights(run)
    assert same_start(entries[1], entries[:1]) is entries[0]
    elsewhere = replace(entries[0], start=(9.0, 0.0, 0.0))
    with pytest.raises(RecordingError, match="no recorded flight starts as"):
        same_start(entries[1], [elsewhere])
