"""The model of a run as queues, and the page that quotes it."""

import json
from pathlib import Path

import pytest

from apex_bat.config import Config
from benchmarks.scaling import SCALES, Setup, at_speed, predict
from benchmarks.scaling_costs import costs_of
from benchmarks.scaling_model import Costs, Outcome, Run, Simulation
from benchmarks.scaling_page import FILE, document

PAGE = Path(__file__).parents[1] / "docs" / "scaling.md"
COSTS = Costs(step_s=500e-6, insert_s=250e-6, request_s=100e-6, item_s=2e-6, update_s=15e-3)


def simulated(run: Run, costs: Costs = COSTS, duration_s: float = 8.0) -> Outcome:
    return Simulation(run, costs).outcome(duration_s)


def test_the_page_is_the_one_made_from_the_committed_results() -> None:
    records = json.loads(FILE.read_text(encoding="utf-8"))
    assert PAGE.read_text(encoding="utf-8") == document(records)
    assert costs_of(records).step_s > 0


def test_actors_that_nobody_holds_fly_as_fast_as_their_cores() -> None:
    outcome = simulated(Run(actors=5))
    assert outcome.steps_per_s == pytest.approx(5 / 500e-6, rel=0.02)
    assert outcome.actors_held == 0.0
    assert outcome.server_busy == pytest.approx(5 / 500e-6 / 50 * 250e-6 + outcome.updates_per_s * 228e-6, rel=0.05)


def test_under_the_law_the_slower_side_sets_the_pace_and_the_ratio_holds() -> None:
    slow_learner = simulated(Run(actors=4, band=8000.0))
    assert slow_learner.updates_per_s == pytest.approx(1 / 15e-3, rel=0.02)
    assert slow_learner.steps_per_s == pytest.approx(64 / 15e-3 / 8, rel=0.05)
    assert slow_learner.samples_per_insert == pytest.approx(8.0, rel=0.05)
    slow_actors = simulated(Run(actors=1, samples_per_insert=0.2, band=8000.0))
    assert slow_actors.steps_per_s == pytest.approx(1 / 500e-6, rel=0.02)
    assert slow_actors.learner_busy < 0.2


def test_a_server_is_the_limit_when_its_core_is_full_and_more_servers_lift_it() -> None:
    costs = COSTS._replace(insert_s=5e-3)
    one, two = simulated(Run(actors=8), costs, 5.0), simulated(Run(actors=8, servers=2), costs, 5.0)
    assert one.server_busy == pytest.approx(1.0, abs=0.02)
    assert one.actors_held > 0.2
    assert two.steps_per_s == pytest.approx(min(8 / 500e-6, 2 * one.steps_per_s), rel=0.1)


def test_shared_cores_are_shared_evenly() -> None:
    outcome = simulated(Run(actors=3, samples_per_insert=1e-3, shared_cores=2))
    total = outcome.steps_per_s * (500e-6 + 250e-6 / 50) + outcome.updates_per_s * (15e-3 + 228e-6)
    assert total == pytest.approx(2.0, rel=0.02), "both cores are full, of these three alone"
    assert outcome.updates_per_s == pytest.approx(2 / 4 / 15e-3, rel=0.1), "a quarter of both for each of four"


def test_the_settings_reach_the_model() -> None:
    few = predict(Config(), COSTS, None, 10.0)
    assert few.steps_per_s == pytest.approx(64 / 15e-3 / 8, rel=0.1)
    assert Setup(4, 8.0).name == "ratio_8.actors_4"
    assert len({scale.name for scale in SCALES}) == len(SCALES)


def test_a_faster_device_hastens_the_update_and_not_what_its_host_does() -> None:
    costs = Costs(1.0, 1.0, 1.0, 1.0, update_s=8e-3, update_item_s=1e-4, take_s=3e-3, take_item_s=1e-5)
    assert costs.learn_s(100) == pytest.approx(8e-3 + 10e-3 + 3e-3 + 1e-3)
    assert at_speed(costs, 20.0).learn_s(100) == pytest.approx(18e-3 / 20 + 4e-3)


def test_a_larger_batch_takes_the_learner_longer() -> None:
    costs = COSTS._replace(update_s=5e-3, update_item_s=1e-4)
    run = Run(actors=2, batch_size=200)
    assert simulated(run, costs).updates_per_s == pytest.approx(1 / 25e-3, rel=0.02)
