"""Which flights are recorded, and which recordings go first."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import Config, load
from apex_bat.config.settings import Recording
from apex_bat.recording.flight import Flight
from apex_bat.recording.keeping import MOST_LOGGED, choose, keep_flights, num_logged, prune


@pytest.fixture
def flights(fly: Callable[..., Flight]) -> list[Flight]:
    """Six flights: 1 and 4 reach the limit, 4 came farther; 0, 2, 3 and 5 crash, 3 soonest."""
    made = []
    for number, way_m in enumerate((3.0, 50.0, 7.0, 1.0, -60.0, 4.0)):
        flight = fly(6, num_points=0)
        completed = number in (1, 4)
        facts = replace(flight.facts, kind="evaluation", arena="simple", actor=None, episode=number)
        made.append(
            replace(
                flight,
                facts=facts,
                end="time" if completed else "contact",
                contact=np.zeros(6, bool) if completed else flight.contact,
                progress_m=np.full(6, way_m, np.float32),
            )
        )
    return made


def marks(flights: Sequence[Flight]) -> dict[int, str]:
    return {flight.facts.episode: flight.facts.mark for flight in flights}


def test_first_best_worst_and_crashes_are_chosen_once_each(flights: list[Flight]) -> None:
    assert marks(choose(flights, Recording(crashes=2), 2)) == {0: "crash", 1: "", 2: "crash", 3: "worst", 4: "best"}


def test_crashes_that_flew_longest_before_are_chosen(fly: Callable[..., Flight]) -> None:
    lengths = (4, 9, 5, 8, 3)
    flights = [replace(flight, facts=replace(flight.facts, episode=i)) for i, flight in enumerate(map(fly, lengths))]
    chosen = marks(choose(flights, Recording(extremes=False, crashes=2), 1))
    assert chosen == {0: "", 1: "crash", 3: "crash"}


def test_each_choice_can_be_switched_off(flights: list[Flight]) -> None:
    assert marks(choose(flights, Recording(extremes=False, crashes=0), 2)) == {0: "", 1: ""}
    assert marks(choose(flights, Recording(extremes=False, crashes=1), 1)) == {0: "crash"}
    assert choose(flights, Recording(), 0) == []


def test_a_single_flight_is_the_best(flights: list[Flight]) -> None:
    assert marks(choose(flights[:1], Recording(), 3)) == {0: "best"}


def test_all_flights_are_logged_only_when_one_is_sought_among_them() -> None:
    assert num_logged(Recording(), 3) == MOST_LOGGED
    assert num_logged(Recording(extremes=False, crashes=0), 3) == 3
    assert num_logged(Recording(), 0) == 0


def test_kept_flights_carry_their_marks_in_their_names(flights: list[Flight], tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    config = load(None, ["recording.crashes=0"])
    paths = keep_flights(flights, config, tmp_path, num_first=1, draw=False)
    assert [path.stem.partition("seed3-")[2] for path in paths] == ["000000", "000003-worst", "000004-best"]
    assert {path.name for path in (tmp_path / "recordings").glob("*.rrd")} == {path.name for path in paths}
    assert len(list((tmp_path / "recordings").glob("*.rbl"))) == 3


def test_a_flight_that_gets_another_mark_is_kept_once(flights: list[Flight], tmp_path: Path) -> None:
    for num_first in (1, 2):
        keep_flights(flights[:num_first], Config(), tmp_path, num_first=num_first, draw=False)
    numbers = [path.name.partition("-00000")[2][0] for path in (tmp_path / "recordings").glob("*.rrd")]
    assert sorted(numbers) == sorted(set(numbers))


def test_recordings_stay_below_the_bound(flights: list[Flight], tmp_path: Path) -> None:
    whole = Config()
    bounded = load(None, ["recording.max_mb=0.5"])
    assert len(keep_flights(flights[:2], whole, tmp_path, draw=False)) == 2
    assert len(list((tmp_path / "recordings").glob("*.rrd"))) == 2
    keep_flights(flights[2:3], bounded, tmp_path, draw=False)
    assert [path.stem[-6:] for path in (tmp_path / "recordings").glob("*.rrd")] == ["000002"]


def test_prune_takes_training_first_marked_ones_last_and_spares_the_newest_and_the_curves(tmp_path: Path) -> None:
    names = ["evaluation-1-best.rrd", "evaluation-2.rrd", "training-3.rrd", "evaluation-4.rrd.part", "training.rrd",
             "evaluation-5.rrd"]  # fmt: skip
    for age, name in enumerate(names):
        path = tmp_path / name
        path.write_bytes(bytes(1000))
        os.utime(path, ns=(age, age))
    assert prune(tmp_path, 0.006) == []
    assert [path.name for path in prune(tmp_path, 0.0045)] == ["training-3.rrd", "evaluation-4.rrd.part"]
    assert [path.name for path in prune(tmp_path, 0.0035)] == ["evaluation-2.rrd"]
    assert [path.name for path in prune(tmp_path, 0.0)] == ["evaluation-1-best.rrd"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["evaluation-5.rrd", "training.rrd"]
