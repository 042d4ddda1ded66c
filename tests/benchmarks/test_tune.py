"""The search for settings, with made-up trainings."""

import json
import math
from typing import Any

import pytest

from apex_bat.config import load
from benchmarks import tune
from benchmarks.peers import contest
from benchmarks.peers.terms import CONFIG_FILE, terms
from benchmarks.tune import Seen, again, changed, propose, search, see, train, value_of
from benchmarks.tune_page import FILE, page


class FakeTrial:
    """Proposes the least of everything."""

    def __init__(self, number: int) -> None:
        self.number, self.notes = number, dict[str, Any]()

    def suggest_int(self, name: str, low: int, high: int) -> int:
        assert low < high, name
        return low

    def suggest_float(self, name: str, low: float, high: float, *, log: bool) -> float:
        assert low < high, name
        assert log
        return low

    def suggest_categorical(self, name: str, choices: tuple[int, ...]) -> int:
        assert len(choices) > 1, name
        return choices[0]

    def set_user_attr(self, key: str, value: Any) -> None:
        self.notes[key] = value


class FakeStudy:
    """Keeps what it was told."""

    def __init__(self) -> None:
        self.told: list[tuple[FakeTrial, float]] = []

    def ask(self) -> FakeTrial:
        return FakeTrial(len(self.told))

    def tell(self, trial: FakeTrial, values: float) -> None:
        self.told.append((trial, values))


def test_every_trial_is_told_with_its_time_and_has_a_seed_of_its_own() -> None:
    study, seeds = FakeStudy(), list[int]()

    def measure(settings: Any, seed: int) -> Seen:
        assert settings["learner.batch_size"] == 32
        seeds.append(seed)
        return (Seen(100.0, 15), Seen(math.inf, 7), Seen(math.inf, 0))[seed]

    lines = list(search(study, 3, 360.0, measure))
    assert [value for _, value in study.told] == [100.0, 540.0, 720.0]
    assert [trial.notes for trial, _ in study.told] == [{"most_completed": n} for n in (15, 7, 0)]
    assert seeds == [0, 1, 2]
    assert lines[1].startswith("trial 1: 540 s, at most 7 of 15 (actors 1, ")


def test_the_search_begins_with_what_ships_within_the_bounds_of_the_search() -> None:
    shipped = tune.shipped()
    assert load(CONFIG_FILE, [f"{name}={number}" for name, number in shipped.items()]) == terms()
    asked = dict[str, Any]()

    class Bounds(FakeTrial):
        def suggest_int(self, name: str, low: int, high: int) -> int:
            asked[name] = low <= shipped[name] <= high
            return low

        def suggest_float(self, name: str, low: float, high: float, *, log: bool) -> float:
            asked[name] = low <= shipped[name] <= high and log
            return low

        def suggest_categorical(self, name: str, choices: tuple[int, ...]) -> int:
            asked[name] = shipped[name] in choices
            return choices[0]

    propose(Bounds(0))
    assert asked == dict.fromkeys(shipped, True)


def test_settings_are_trained_anew_by_turns() -> None:
    order: list[tuple[float, int]] = []

    def measure(settings: Any, seed: int) -> Seen:
        order.append((settings["actors"], seed))
        return Seen(10.0 * settings["actors"] + seed, 15)

    assert again([{"actors": 1}, {"actors": 2}], [1, 2], 60.0, measure) == [[11.0, 12.0], [21.0, 22.0]]
    assert order == [(1, 1), (2, 1), (1, 2), (2, 2)]


def test_what_ships_is_changed_in_what_is_named_alone() -> None:
    shipped = {"actors": 2, "replay.samples_per_insert": 8.0, "learner.batch_size": 64}
    assert changed(shipped, "actors=1") == shipped | {"actors": 1}
    both = changed(shipped, "actors=1,replay.samples_per_insert=4")
    assert both == shipped | {"actors": 1, "replay.samples_per_insert": 4.0}
    assert isinstance(both["replay.samples_per_insert"], float)
    with pytest.raises(KeyError, match="actor"):
        changed(shipped, "actor=1")


def test_the_page_shows_what_ships_beside_what_was_found() -> None:
    shipped, found = {"actors": 2, "learner.learning_rate": 2.5e-4}, {"actors": 1, "learner.learning_rate": 1e-3}
    text = page({
        "machine": {"cores": 2}, "limit_s": 60.0, "period_s": 3.0, "shipped": shipped, "command": "search it",
        "num_random": 1,
        "trials": [
            {"settings": shipped, "value_s": 66.4, "most": 14}, {"settings": found, "value_s": 50.2, "most": 15},
        ],
        "anew": [{"settings": shipped, "values_s": [70.0, 60.0, 90.0]}, {"settings": found, "values_s": []}],
    })  # fmt: skip
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert rows[2] == "| **70** | 70, 60, 90 | * | 2 | 0.00025 |"
    assert rows[-2:] == ["| 50 | 15 |  | 1 | 0.001 |", "| 66 | 14 | * | 2 | 0.00025 |"]


def test_the_page_is_that_of_the_file() -> None:
    assert FILE.with_suffix(".md").read_text() == page(json.loads(FILE.read_text()))


def test_what_never_got_there_is_worse_than_what_did_and_better_the_more_it_completed() -> None:
    order = [Seen(359.0, 14), Seen(math.inf, 13), Seen(math.inf, 5), Seen(math.inf, 0)]
    values = [value_of(seen, 360.0) for seen in order]
    assert values == sorted(values)
    assert len(set(values)) == len(values)


def test_every_proposed_setting_exists() -> None:
    overrides = [f"{name}={number}" for name, number in propose(FakeTrial(0)).items()]
    assert load(None, overrides).learner.learning_rate == 1e-4


def test_the_first_policy_with_enough_flights_gives_the_time_and_what_was_not_judged_gives_none() -> None:
    curve = [
        {"wall_s": time_s, "completed": completed}
        for time_s, completed in ((5.0, 2), (8.0, 13), (11.0, None), (14.0, 15))
    ]  # fmt: skip
    assert see(curve) == Seen(14.0, 15)
    assert see(curve[:3]) == Seen(math.inf, 13)


def test_a_training_is_one_of_the_contest_with_other_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(start: contest.Start, options: contest.Options) -> contest.Result:
        assert (start.entry.name, start.environment, start.seed) == ("apex_bat", "registered", 7)
        assert start.entry.settings == ("actors=1", "learner.batch_size=32")
        assert (options.budgets_s["registered"], options.every_s) == (50.0, tune.PERIOD_S)
        return {"curve": [{"wall_s": 21.0, "completed": 14}]}

    monkeypatch.setattr(contest, "run", run)
    assert train({"actors": 1, "learner.batch_size": 32}, 7, 50.0) == Seen(21.0, 14)
