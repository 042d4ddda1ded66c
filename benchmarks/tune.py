"""A search for settings with which a bat learns sooner: the least time to 14 of 15 flights in simple.

    pip install -e '.[tune]'
    python -m benchmarks.tune --trials 30 --minutes 4 --storage tune.sqlite
    python -m benchmarks.tune --trials 0 --minutes 4 --storage tune.sqlite --anew 3 --json docs/results/tune.json

Each trial is one `apex-bat train` with a wall-clock limit, which ends as soon as its evaluator has seen 14 of 15
flights completed. Its value is that time; where it never came, the limit and as much of it again as flights were
missing. The first trial has the settings that ship; Optuna proposes the others (Akiba et al. 2019; tree-structured
Parzen estimator) and keeps all in an SQLite file, so that the same command goes on after an interruption. Every trial
has another seed: what is found does not fit one seed only, and equal settings give different values. The best of many
such values is too good, so the best trials and what ships are trained anew, by turns, with seeds that no trial had;
that is what counts.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from apex_bat.config import load
from benchmarks.peers.contest import machine
from benchmarks.tune_page import page

ENOUGH, NUM_FLIGHTS = 14, 15
CONFIG = "configs/memory.toml"
PERIOD_S = 20.0
"""Between two evaluations of a trial: how exactly its time is known. An evaluation takes up to 8 s of a core."""
NEW_PERIOD_S = 10.0
"""The same for the trainings anew."""
NUM_RANDOM = 8
"""Trials whose settings are drawn at random, until there is something to learn from."""
LOOK_S = 0.5
FIRST_NEW_SEED = 1000
"""Of the trainings anew; trials have the seeds from 0 on."""
START_S, END_S = 60.0, 60.0
"""How long a trial may take until it flies, and to end."""

Settings = Mapping[str, int | float]
Measure = Callable[[Settings, int], "Seen"]


class Trial(Protocol):
    """What is needed of `optuna.Trial`."""

    number: int

    def suggest_int(self, name: str, low: int, high: int) -> int:
        """Returns a whole number."""

    def suggest_float(self, name: str, low: float, high: float, *, log: bool) -> float:
        """Returns a number, evenly on a logarithmic scale."""

    def suggest_categorical(self, name: str, choices: tuple[int, ...]) -> int:
        """Returns one of some."""

    def set_user_attr(self, key: str, value: Any) -> None:
        """Keeps a note."""


class Study(Protocol):
    """What is needed of `optuna.Study`."""

    def ask(self) -> Any:
        """Returns a new trial."""

    def tell(self, trial: Any, values: float) -> Any:
        """Takes a trial's value."""


class Seen(NamedTuple):
    """What the evaluator of a trial saw."""

    time_s: float
    """From the first environment step until enough flights were completed; infinite if they never were."""
    most: int
    """Flights completed by the best policy."""


def propose(trial: Trial) -> dict[str, int | float]:
    """Returns the settings of a trial, by their names in docs/settings.md."""
    return {
        "actors": trial.suggest_int("actors", 1, 3),
        "bats_per_actor": trial.suggest_categorical("bats_per_actor", (8, 16, 32)),
        "replay.samples_per_insert": trial.suggest_float("replay.samples_per_insert", 2.0, 16.0, log=True),
        "learner.batch_size": trial.suggest_categorical("learner.batch_size", (32, 64, 128, 256)),
        "learner.learning_rate": trial.suggest_float("learner.learning_rate", 5e-5, 2e-3, log=True),
    }


def shipped() -> dict[str, int | float]:
    """Returns the settings that a user of this machine has, in the form of a trial's: where the search begins."""
    config = load(Path(CONFIG))
    return {
        "actors": config.actors,
        "bats_per_actor": config.bats_per_actor,
        "replay.samples_per_insert": config.replay.samples_per_insert,
        "learner.batch_size": config.learner.batch_size,
        "learner.learning_rate": config.learner.learning_rate,
    }


def value_of(seen: Seen, limit_s: float) -> float:
    """Returns what is to be small, in s: the time, or the limit and as much of it again as flights were missing."""
    if math.isfinite(seen.time_s):
        return seen.time_s
    return limit_s * (1.0 + (ENOUGH - min(seen.most, ENOUGH)) / ENOUGH)


def search(study: Study, num_trials: int, limit_s: float, measure: Measure) -> Iterator[str]:
    """Makes trials and tells the study their values; yields a line about each.

    Args:
        study: proposes settings and keeps the values.
        num_trials: how many further trials.
        limit_s: wall-clock limit of a trial.
        measure: trains with some settings and a seed.
    """
    for _ in range(num_trials):
        trial = study.ask()
        settings = propose(trial)
        seen = measure(settings, trial.number)
        trial.set_user_attr("most_completed", seen.most)
        value = value_of(seen, limit_s)
        study.tell(trial, value)
        yield f"trial {trial.number}: {value:.0f} s, at most {seen.most} of {NUM_FLIGHTS} ({words(settings)})"


def see(rows: Iterator[Mapping[str, Any]]) -> Seen:
    """Returns what the rows of an evaluator's metrics say."""
    most = 0
    for row in rows:
        completed = round(NUM_FLIGHTS * float(row.get("completed_share", 0.0)))
        most = max(most, completed)
        if completed >= ENOUGH:
            return Seen(float(row["elapsed_s"]), most)
    return Seen(math.inf, most)


def train(settings: Settings, seed: int, limit_s: float, folder: Path, period_s: float = PERIOD_S) -> Seen:
    """Trains with some settings until enough flights are completed or the time is over; returns what was seen.

    Raises:
        RuntimeError: the training failed, or did not end.
    """
    run = folder / "run"
    fixed = {
        "seed": seed, "train.max_minutes": limit_s / 60.0, "evaluation.flights": NUM_FLIGHTS,
        "evaluation.period_s": period_s, "checkpoint.period_s": period_s / 2.0, "evaluation.arenas": "[]",
    }  # fmt: skip
    command = [sys.executable, "-m", "apex_bat", "train", "--config", CONFIG, "--plain", "--run", str(run)]
    for key, number in (fixed | dict(settings)).items():
        command += ["--set", f"{key}={number}"]
    metrics, deadline_s = run / "metrics" / "evaluator.jsonl", time.monotonic() + START_S + limit_s + END_S
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as launcher:
        try:
            while launcher.poll() is None and time.monotonic() < deadline_s:
                if math.isfinite(see(_rows(metrics)).time_s):
                    launcher.send_signal(signal.SIGINT)
                    launcher.wait(END_S)
                time.sleep(LOOK_S)
        finally:
            if launcher.poll() is None:
                launcher.terminate()
    seen = see(_rows(metrics))
    if launcher.returncode not in (0, 130) or not metrics.exists():
        raise RuntimeError(f"the training ended with code {launcher.returncode}; see {run / 'logs'}")
    return seen


def _rows(path: Path) -> Iterator[Mapping[str, Any]]:
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
            if line.endswith("\n"):  # else it is being written
                yield json.loads(line)


def again(candidates: Sequence[Settings], seeds: Sequence[int], limit_s: float, measure: Measure) -> list[list[float]]:
    """Trains settings anew, by turns: each with the first seed, then each with the second.

    Returns:
        values of each candidate, s, in the order of the seeds.
    """
    values: list[list[float]] = [[] for _ in candidates]
    for seed in seeds:
        for settings, found in zip(candidates, values, strict=True):
            found.append(value_of(measure(settings, seed), limit_s))
            print(f"seed {seed}: {found[-1]:.0f} s ({words(settings)})", flush=True)
    return values


def changed(settings: Settings, change: str) -> Settings:
    """Returns settings with one of them changed, KEY=NUMBER."""
    key, _, text = change.partition("=")
    return {**settings, key: type(settings[key])(text)}


def words(settings: Settings) -> str:
    """Returns settings as text."""
    return ", ".join(f"{name} {number:.3g}" for name, number in settings.items())


def main() -> None:
    """Searches, trains the best anew, and writes what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=30, help="further trials")
    parser.add_argument("--minutes", type=float, default=6.0, help="wall-clock limit of a trial")
    parser.add_argument("--storage", type=Path, default=Path("tune.sqlite"))
    parser.add_argument("--anew", type=int, default=0, metavar="SEEDS", help="train the best and what ships anew")
    parser.add_argument("--best", type=int, default=2, help="how many of the best are trained anew")
    parser.add_argument(
        "--also", action="append", default=[], metavar="KEY=NUMBER", help="a change of what ships, alone"
    )
    parser.add_argument("--json", type=Path, dest="file", help="where to write all; the page is written beside it")
    given = parser.parse_args()
    import optuna

    limit_s = 60.0 * given.minutes
    name = f"time to {ENOUGH} of {NUM_FLIGHTS} within {given.minutes:g} min"
    study = optuna.create_study(
        storage=f"sqlite:///{given.storage}", study_name=name,
        sampler=optuna.samplers.TPESampler(n_startup_trials=NUM_RANDOM, multivariate=True), load_if_exists=True,
    )  # fmt: skip
    if not study.trials:
        study.enqueue_trial(shipped())

    def measure(settings: Settings, seed: int, period_s: float = PERIOD_S) -> Seen:
        with tempfile.TemporaryDirectory(prefix="tune-") as folder:
            return train(settings, seed, limit_s, Path(folder), period_s)

    for line in search(study, given.trials, limit_s, measure):
        print(line, flush=True)
    done: list[Any] = [trial for trial in study.trials if trial.value is not None]
    ordered = sorted(done, key=lambda trial: float(trial.value))
    found = [trial.params for trial in ordered if trial.params != shipped()][: given.best]
    candidates = [shipped(), *(changed(shipped(), change) for change in given.also), *found]
    seeds = range(FIRST_NEW_SEED, FIRST_NEW_SEED + given.anew)
    values = again(candidates, seeds, limit_s, partial(measure, period_s=NEW_PERIOD_S))
    if given.file is not None:
        content = {
            "machine": machine(), "limit_s": limit_s, "period_s": PERIOD_S, "new_period_s": NEW_PERIOD_S,
            "shipped": shipped(),
            "trials": [
                {"settings": one.params, "value_s": one.value, "most": one.user_attrs["most_completed"]} for one in done
            ],
            "anew": [
                {"settings": dict(settings), "values_s": found}
                for settings, found in zip(candidates, values, strict=True)
            ],
        }  # fmt: skip
        given.file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        given.file.with_suffix(".md").write_text(page(content), encoding="utf-8")


if __name__ == "__main__":
    main()
