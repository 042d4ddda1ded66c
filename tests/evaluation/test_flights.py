"""Greedy flights: counted once, judged right, the same for equal seeds."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from apex_bat.agent.inference import PolicyValues
from apex_bat.config import Config, load
from apex_bat.evaluation.flights import fly, score
from apex_bat.experience import States
from apex_bat.simulation.arenas import arena_folder

CONFIG = load(None, ["episode.evaluation_steps=60", "sonar.rendering=exact"])


def always(action: int) -> Callable[[States], PolicyValues]:
    """Returns a policy that wants one action whatever it hears."""

    def policy(states: States) -> PolicyValues:
        q = np.zeros((len(states.echoes), 3), np.float32)
        q[:, action] = 1.0
        return PolicyValues(q, q[:, :1], q)

    return policy


def test_straight_on_ends_at_a_wall_and_spinning_completes_without_progress() -> None:
    straight, _ = fly(always(0), CONFIG, "simple", num_flights=4, seed=1)
    spinning, _ = fly(always(1), CONFIG, "simple", num_flights=4, seed=1)
    assert all(record.collided and not record.completed and record.steps < 60 for record in straight)
    assert all(record.action_shares == (1.0, 0.0, 0.0) for record in straight)
    completed = [record for record in spinning if record.completed]
    assert completed
    for record in completed:
        assert record.steps == 60
        assert record.distance_m == pytest.approx(60 * 0.15, rel=1e-6)
        assert record.progress_m < 1.5
    assert score(spinning) > score(straight)


def test_equal_seeds_give_equal_flights_and_equal_starts_for_every_policy() -> None:
    first, _ = fly(always(0), CONFIG, "simple", num_flights=3, seed=5)
    again, _ = fly(always(0), CONFIG, "simple", num_flights=3, seed=5)
    other, _ = fly(always(2), CONFIG, "simple", num_flights=3, seed=5)
    assert first == again
    assert [record.start for record in first] == [record.start for record in other]
    assert len({record.start for record in first}) == 3


def test_a_recorded_flight_agrees_with_its_record() -> None:
    records, flights = fly(always(0), CONFIG, "simple", num_flights=3, seed=2, num_recorded=2, checkpoint_step=9)
    assert len(flights) == 2
    for flight in flights:
        record = records[flight.facts.episode]
        assert flight.num_steps == record.steps
        assert flight.end == "contact"
        assert flight.reward.sum() == pytest.approx(record.reward, abs=1e-5)
        assert flight.distance_m[-1] == pytest.approx(record.distance_m, rel=1e-5)
        np.testing.assert_allclose(flight.poses[0], record.start)
        np.testing.assert_allclose(np.quantile(flight.clearance_m, 0.5), record.clearance_quantiles_m[3], rtol=1e-5)
        assert flight.facts.checkpoint_step == 9


def test_flights_can_be_broken_off() -> None:
    assert fly(always(0), CONFIG, "simple", num_flights=2, seed=1, is_stopped=lambda: True) == ([], [])


def test_records_are_plain_values_for_json() -> None:
    records, _ = fly(always(0), Config(), "simple", num_flights=1, seed=1)
    row = msgspec.json.decode(msgspec.json.encode(records[0]))
    assert row["arena"] == "simple"
    assert len(row["clearance_quantiles_m"]) == 6


def test_flights_in_a_family_name_the_arena_of_each() -> None:
    records, flights = fly(always(0), CONFIG, "corridor:0-3", num_flights=8, seed=1, num_recorded=8)
    names = {record.arena for record in records}
    assert len(names) > 1
    assert names <= {f"corridor:{seed}" for seed in range(4)}
    assert [flight.facts.arena for flight in flights] == sorted(record.arena for record in records)


def test_flights_in_a_users_arena_name_its_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text((arena_folder() / "simple.toml").read_text())
    records, flights = fly(always(0), CONFIG, str(path), num_flights=1, seed=1, num_recorded=1)
    assert records[0].arena == flights[0].facts.arena == str(path)
