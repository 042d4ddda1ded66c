"""The log of a flight keeps what it is given, and is light."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

from apex_bat.recording.flight import Flight, FlightFacts, FlightLog


def test_log_copies_what_it_is_given() -> None:
    log = FlightLog(FlightFacts(arena="a", condition="memory"), memory_steps=1, heavy_period_steps=1)
    frame, ranges_m = np.ones((2, 24), np.float32), np.ones(5, np.float32)
    _append(log, frame=frame, ranges_m=ranges_m)
    frame[:], ranges_m[:] = 9.0, 9.0
    flight = log.finish(np.zeros(3), "time")
    assert flight.frame.max() == 1.0
    assert flight.ranges_m is not None
    assert flight.ranges_m.max() == 1.0


def test_log_grows_beyond_its_first_room() -> None:
    log = FlightLog(FlightFacts(arena="a", condition="memory"), memory_steps=1, max_steps=2)
    for step in range(7):
        _append(log, value=float(step))
    assert log.finish(np.zeros(3), "time").value.tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_poses_are_those_of_the_calls_and_the_last() -> None:
    log = FlightLog(FlightFacts(arena="a", condition="memory"), memory_steps=1)
    for step in range(3):
        _append(log, pose=np.array([step, 0.0, 0.0]))
    flight = log.finish(np.array([3.0, 0.0, 0.0]), "time")
    assert flight.poses[:, 0].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("num_steps", "steps"), [(1, [0]), (5, [0]), (6, [0, 5]), (11, [0, 5, 10])])
def test_ranges_are_kept_at_every_fifth_step(fly: Callable[..., Flight], num_steps: int, steps: list[int]) -> None:
    flight = fly(num_steps, heavy_period_steps=5)
    assert flight.heavy_steps.tolist() == steps


def test_flight_without_ranges_has_no_heavy_steps(fly: Callable[..., Flight]) -> None:
    assert fly(6, num_points=0).heavy_steps.tolist() == []


def test_ranges_at_some_steps_only_are_refused() -> None:
    log = FlightLog(FlightFacts(arena="a", condition="memory"), memory_steps=1, heavy_period_steps=1)
    _append(log, ranges_m=np.ones(5, np.float32))
    _append(log)
    with pytest.raises(ValueError, match="all or none"):
        log.finish(np.zeros(3), "time")


def test_flight_without_steps_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one step"):
        FlightLog(FlightFacts(arena="a", condition="memory"), memory_steps=1).finish(np.zeros(3), "time")


def test_derived_numbers_follow_from_the_rows(flight: Flight) -> None:
    np.testing.assert_allclose(flight.returns[-1], flight.reward.sum(), rtol=1e-6)
    assert flight.times_s[10] == pytest.approx(0.5)
    assert flight.chosen_q.tolist() == [float(flight.q[k, a]) for k, a in enumerate(flight.action)]


@pytest.mark.parametrize("arena", ["simple", "corridor:*", "C:\\my arenas\\yard.toml", "/a/b/yard.toml", "a?b|c"])
def test_file_names_are_allowed_on_windows(arena: str) -> None:
    name = FlightFacts(arena=arena, condition="onset", kind="training", actor=3, episode=7).file_name()
    assert not set(name) & set('<>:"/\\|?* ')
    assert name.endswith("-000007.rrd")


def test_flights_of_a_run_have_different_file_names() -> None:
    facts = [
        FlightFacts(arena="simple", condition="memory"),
        FlightFacts(arena="narrow", condition="memory"),
        FlightFacts(arena="simple", condition="memory", episode=1),
        FlightFacts(arena="simple", condition="memory", seed=1),
        FlightFacts(arena="simple", condition="memory", actor=0),
        FlightFacts(arena="simple", condition="memory", checkpoint_step=100),
    ]
    assert len({each.file_name() for each in facts}) == len(facts)


def test_importing_the_log_imports_neither_rerun_nor_matplotlib() -> None:
    code = "import sys, apex_bat.recording.flight; print({'rerun', 'matplotlib', 'pybullet'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert run.stdout.strip() == "set()"


def _append(log: FlightLog, **changes: object) -> None:
    row: dict[str, object] = {
        "pose": np.zeros(3),
        "frame": np.zeros((2, 24), np.float32),
        "state": np.zeros((2, 24), np.float32),
        "q": np.zeros(3, np.float32),
        "value": 0.0,
        "advantage": np.zeros(3, np.float32),
        "action": 0,
        "reward_straight": 0.0,
        "reward_near": 0.0,
        "reward": 0.0,
        "clearance_m": 1.0,
        "progress_m": 0.0,
        "distance_m": 0.0,
        "contact": False,
    }
    log.append(**(row | changes))  # type: ignore[arg-type]
