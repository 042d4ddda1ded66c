"""Runs sorted into groups that may be compared: the same settings but for the seed.

A group is named by its condition and by the settings in which it differs from the default, whatever other runs there
are: what most runs have in common may be far from the thesis.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import Config
from apex_bat.config.loading import differences
from apex_bat.evaluation.flights import FlightRecord
from apex_bat.evaluation.results import Judged

CONDITIONS = ("memory", "no_memory", "onset")
"""Those of the thesis, in its order."""
DIFFERENT_ANYWAY = (
    "seed", "condition", "device", "train.*", "launch.*", "recording.*", "transport.*", "checkpoint.*", "evaluation.*",
    "replay.snapshot_period_s", "learner.precision", "learner.compile", "learner.prefetch",
)  # fmt: skip
"""Settings that do not make another experiment; how long each run trained is compared by its steps."""
MOST_NAMED = 3
"""Settings that a label names; more of them are counted there and listed in the report's last part."""


@dataclass(frozen=True, eq=False)
class Group:
    """Runs of one condition that differ by their seeds, or a baseline."""

    label: str
    """The condition, or the name of a baseline; with settings where they differ from the default."""
    condition: str
    runs: list[Judged]
    """By seed, then by name."""
    is_trained: bool = True
    others: tuple[str, ...] = ()
    """Settings, as `key value`, in which it differs from the default."""

    @property
    def seeds(self) -> list[int]:
        """Seeds that it was trained from, each once."""
        return sorted({run.config.seed for run in self.runs})

    @property
    def num_seeds(self) -> int:
        """How many seeds it was trained from; repetitions of a seed count once."""
        return len(self.seeds)

    def first_of(self, seed: int) -> Judged:
        """Returns the run of a seed: the first by name, where the seed was trained from more than once."""
        return next(run for run in self.runs if run.config.seed == seed)

    def scores(self, arenas: Sequence[str], value: Callable[[FlightRecord], float]) -> NDArray[np.float64]:
        """Returns a number of each flight: float64 (seeds, arenas, flights).

        Where a seed was trained from more than once, it is the mean over those runs, flight by flight: flight k of each
        began at the same pose.
        """
        of_seeds = [[run.scores(arenas, value) for run in self.runs if run.config.seed == seed] for seed in self.seeds]
        return np.stack([np.mean(of_seed, axis=0) for of_seed in of_seeds])


def group(judged: Sequence[Judged], baselines: Sequence[Judged] = ()) -> list[Group]:
    """Returns the groups, those of the thesis's conditions first and baselines last.

    A run trained from a seed that its group has already is kept too: repetitions of a seed differ when trained
    asynchronously. Its facts stand in the report.
    """
    found: dict[tuple[str, tuple[str, ...]], list[Judged]] = {}
    for run in judged:
        found.setdefault((run.condition, settings_apart(run.config)), []).append(run)
    keys = sorted(found, key=lambda key: (CONDITIONS.index(key[0]), len(key[1]), key[1]))
    groups = [
        Group(_label(*key), key[0], sorted(found[key], key=lambda run: (run.config.seed, run.name)), others=key[1])
        for key in keys
    ]
    return groups + [Group(each.name, each.condition, [each], is_trained=False) for each in baselines]


def thesis_groups(groups: Sequence[Group]) -> dict[str, Group]:
    """Returns the group of each condition that is held against the thesis.

    They are those of the default settings. Where there are none, as when a campaign trained all with another learning
    rate, they are those of the only settings there are; of several it cannot be said which the thesis's are.
    """
    trained = [each for each in groups if each.is_trained]
    settings = {each.others for each in trained}
    chosen = () if () in settings else settings.pop() if len(settings) == 1 else None
    return {each.condition: each for each in trained if each.others == chosen}


def settings_apart(config: Config, reference: Config = Config()) -> tuple[str, ...]:  # noqa: B008
    """Returns the settings of a run, as `key value`, in which it is another experiment than the reference."""
    lines = (line.partition(": ") for line in differences(config, reference))
    return tuple(
        f"{key} {values.partition(' | ')[0]}"
        for key, _, values in sorted(lines)
        if not any(fnmatch(key, pattern) for pattern in DIFFERENT_ANYWAY)
    )


def long_labels(groups: Sequence[Group]) -> Mapping[str, str]:
    """Returns all settings of each group whose label only counts them."""
    return {each.label: ", ".join(each.others) for each in groups if len(each.others) > MOST_NAMED}


def _label(condition: str, others: tuple[str, ...]) -> str:
    if not others:
        return condition
    if len(others) <= MOST_NAMED:
        return f"{condition} ({', '.join(others)})"
    mark = hashlib.sha256("\n".join(others).encode()).hexdigest()[:4]  # tells apart those with as many settings
    return f"{condition} ({len(others)} other settings, {mark})"
