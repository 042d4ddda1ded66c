"""The search for settings, with made-up trainings."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from apex_bat.config import load
from benchmarks import tune
from benchmarks.tune import Seen, propose, search, see, train, value_of


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


def test_what_never_got_there_is_worse_than_what_did_and_better_the_more_it_completed() -> None:
    order = [Seen(359.0, 14), Seen(math.inf, 13), Seen(math.inf, 5), Seen(math.inf, 0)]
    values = [value_of(seen, 360.0) for seen in order]
    assert values == sorted(values)
    assert len(set(values)) == len(values)


def test_every_proposed_setting_exists() -> None:
    overrides = [f"{name}={number}" for name, number in propose(FakeTrial(0)).items()]
    assert load(None, overrides).learner.learning_rate == 5e-5


def test_the_first_row_with_enough_flights_gives_the_time() -> None:
    rows: list[dict[str, Any]] = [
        {"elapsed_s": 5.0}, {"elapsed_s": 30.0, "completed_share": 13 / 15},
        {"elapsed_s": 50.0, "completed_share": 14 / 15}, {"elapsed_s": 70.0, "completed_share": 1.0},
    ]  # fmt: skip
    assert see(iter(rows)) == Seen(50.0, 14)
    assert see(iter(rows[:2])) == Seen(math.inf, 13)


def _stand_in(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Starts another program instead of a training; it gets the run folder as its last argument."""
    popen = subprocess.Popen

    def start(command: list[str], **kwargs: Any) -> Any:
        assert command[1:4] == ["-m", "apex_bat", "train"]
        run = command[command.index("--run") + 1]
        (Path(run) / "metrics").mkdir(parents=True)
        return popen([sys.executable, "-c", code, f"{run}/metrics/evaluator.jsonl"], **kwargs)

    monkeypatch.setattr(tune.subprocess, "Popen", start)  # type: ignore[attr-defined]
    monkeypatch.setattr(tune, "LOOK_S", 0.01)


def test_a_training_ends_when_enough_flights_were_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = json.dumps({"elapsed_s": 42.0, "completed_share": 1.0})
    _stand_in(
        monkeypatch,
        "import signal, sys\nsignal.signal(signal.SIGINT, lambda *_: sys.exit(130))\n"
        f"open(sys.argv[1], 'w').write({row!r} + chr(10) + '{{')\nsignal.pause()\n",
    )
    assert train({"actors": 1}, 3, 600.0, tmp_path) == Seen(42.0, 15)


def test_a_training_that_fails_is_no_value(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _stand_in(monkeypatch, "raise SystemExit(2)")
    with pytest.raises(RuntimeError, match="code 2"):
        train({"actors": 1}, 3, 600.0, tmp_path)
