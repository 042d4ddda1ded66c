"""A search for settings with which a bat learns sooner: the least time to 14 of 15 flights in simple.

    pip install -e '.[tune]'
    python -m benchmarks.tune --trials 30 --storage tune.sqlite
    python -m benchmarks.tune --trials 0 --storage tune.sqlite --anew 3 --json docs/results/tune.json

Each trial is one training as in the contest (`benchmarks.peers`): `apex-bat train` for a fixed time, whose policies are
written every few seconds and judged afterwards, each by 15 flights. Its value is the time from the start of the command
to the first policy that completes 14; where none did, the limit and as much of it again as flights were missing.

The first trial has the settings that ship; Optuna proposes the others (Akiba et al. 2019; tree-structured Parzen
estimator) and keeps all in an SQLite file, so that the same command goes on after an interruption. Every trial has
another seed: what is found does not fit one seed only, and equal settings give different values. The best of many such
values is too good, so the best trials, what ships, and what ships with a change (`--also`) are trained anew, by turns,
with seeds that no trial had; that is what counts.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from apex_bat.launching import ONE_THREAD
from benchmarks.peers import contest
from benchmarks.peers.terms import ENOUGH, entry_of, terms
from benchmarks.tune_page import page

NUM_FLIGHTS = 15
PERIOD_S = 3.0
"""Between two policies: how exactly a time is known."""
NUM_RANDOM = 8
"""Trials whose settings are drawn at random, until there is something to learn from."""
FIRST_NEW_SEED = 1000
"""Of the trainings anew; trials have the seeds from 0 on."""

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
    """What the judged policies of a training came to."""

    time_s: float
    """From the start of the command to the first policy that completes enough flights; infinite if none does."""
    most: int
    """Flights completed by the best policy."""


def propose(trial: Trial) -> dict[str, int | float]:
    """Returns the settings of a trial, by their names in docs/settings.md."""
    return {
        "actors": trial.suggest_int("actors", 1, 2),
        "bats_per_actor": trial.suggest_categorical("bats_per_actor", (8, 16, 32)),
        "replay.samples_per_insert": trial.suggest_float("replay.samples_per_insert", 4.0, 16.0, log=True),
        "learner.batch_size": trial.suggest_categorical("learner.batch_size", (32, 64, 128)),
        "learner.learning_rate": trial.suggest_float("learner.learning_rate", 1e-4, 2e-3, log=True),
        "learner.target_period": trial.suggest_categorical("learner.target_period", (25, 50, 100, 250, 500)),
    }


def shipped() -> dict[str, int | float]:
    """Returns the settings that a user of this machine has, in the form of a trial's: where the search begins."""
    config = terms()
    return {
        "actors": config.actors,
        "bats_per_actor": config.bats_per_actor,
        "replay.samples_per_insert": config.replay.samples_per_insert,
        "learner.batch_size": config.learner.batch_size,
        "learner.learning_rate": config.learner.learning_rate,
        "learner.target_period": config.learner.target_period,
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


def see(curve: Sequence[Mapping[str, Any]]) -> Seen:
    """Returns what the judged policies in the curve of a `contest.Result` came to."""
    judged = [point for point in curve if point["completed"] is not None]
    time_s = next((point["wall_s"] for point in judged if point["completed"] >= ENOUGH), math.inf)
    return Seen(time_s, max(point["completed"] for point in judged))


def train(settings: Settings, seed: int, limit_s: float) -> Seen:
    """Trains with some settings for a while and judges the policies.

    Raises:
        contest.PeerError: the training failed.
    """
    entry = entry_of("apex_bat")._replace(settings=tuple(f"{key}={number}" for key, number in settings.items()))
    options = contest.Options(Path(os.devnull), {"registered": limit_s}, PERIOD_S)
    return see(contest.run(contest.Start(entry, "registered", seed), options)["curve"])


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


def changed(settings: Settings, changes: str) -> Settings:
    """Returns settings with some of them changed, KEY=NUMBER,KEY=NUMBER."""
    made = dict(settings)
    for change in changes.split(","):
        key, _, text = change.partition("=")
        made[key] = type(settings[key])(text)
    return made


def words(settings: Settings) -> str:
    """Returns settings as text."""
    return ", ".join(f"{name} {number:.3g}" for name, number in settings.items())


def main() -> None:
    """Searches, trains the best anew, and writes what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=30, help="further trials")
    parser.add_argument("--limit-s", type=float, default=60.0, help="wall-clock time of a training, from its start")
    parser.add_argument("--storage", type=Path, default=Path("tune.sqlite"))
    parser.add_argument("--anew", type=int, default=0, metavar="SEEDS", help="train the best and what ships anew")
    parser.add_argument("--best", type=int, default=2, help="how many of the best are trained anew")
    parser.add_argument("--also", action="append", default=[], metavar="KEY=NUMBER,...", help="a change of what ships")
    parser.add_argument("--json", type=Path, dest="file", help="where to write all; the page is written beside it")
    given = parser.parse_args()
    import optuna

    for variable in ONE_THREAD:  # in the processes that judge, see `benchmarks.peers`
        os.environ.setdefault(variable, "1")
    measure = partial(train, limit_s=given.limit_s)
    name = f"time to {ENOUGH} of {NUM_FLIGHTS} within {given.limit_s:g} s"
    study = optuna.create_study(
        storage=f"sqlite:///{given.storage}", study_name=name,
        sampler=optuna.samplers.TPESampler(n_startup_trials=NUM_RANDOM, multivariate=True), load_if_exists=True,
    )  # fmt: skip
    if not study.trials:
        study.enqueue_trial(shipped())

    for line in search(study, given.trials, given.limit_s, measure):
        print(line, flush=True)
    done: list[Any] = [trial for trial in study.trials if trial.value is not None]
    ordered = sorted(done, key=lambda trial: float(trial.value))
    found = [trial.params for trial in ordered if trial.params != shipped()][: given.best]
    candidates = [shipped(), *(changed(shipped(), change) for change in given.also), *found]
    seeds = range(FIRST_NEW_SEED, FIRST_NEW_SEED + given.anew)
    values = again(candidates, seeds, given.limit_s, measure)
    if given.file is not None:
        content = {
            "command": shlex.join(["python", "-m", "benchmarks.tune", *sys.argv[1:]]), "machine": contest.machine(),
            "limit_s": given.limit_s, "period_s": PERIOD_S, "num_random": NUM_RANDOM,
            "shipped": shipped(),
            "trials": [
                {"settings": one.params, "value_s": one.value, "most": one.user_attrs["most_completed"]} for one in done
            ],
            "anew": [
                {"settings": dict(settings), "values_s": values_s}
                for settings, values_s in zip(candidates, values, strict=True)
            ],
        }  # fmt: skip
        given.file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        given.file.with_suffix(".md").write_text(page(content), encoding="utf-8")


if __name__ == "__main__":
    main()
