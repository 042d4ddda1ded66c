"""Runs sorted into groups that may be compared: the same settings but for the seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch

import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True, eq=False)
class Group:
    """Runs of one condition that differ by their seeds, or a baseline."""

    label: str
    """The condition, or the name of a baseline; with settings where they differ from those of most runs."""
    condition: str
    runs: list[Judged]
    is_trained: bool = True

    @property
    def num_seeds(self) -> int:
        """Seeds that it was trained from."""
        return len(self.runs)

    def scores(self, arenas: Sequence[str], value: Callable[[FlightRecord], float]) -> NDArray[np.float64]:
        """Returns a number of each flight: float64 (seeds, arenas, flights)."""
        return np.stack([run.scores(arenas, value) for run in self.runs])


def group(judged: Sequence[Judged], baselines: Sequence[Judged] = ()) -> list[Group]:
    """Returns the groups, those of the thesis's conditions first and baselines last.

    A run trained from a seed that its group has already is kept too: repetitions of a seed differ when trained
    asynchronously. Its facts stand in the report.
    """
    found: dict[tuple[str, tuple[str, ...]], list[Judged]] = {}
    for run in judged:
        others = _settings_apart(run, judged)
        found.setdefault((run.condition, others), []).append(run)
    keys = sorted(found, key=lambda key: (CONDITIONS.index(key[0]), len(key[1]), key[1]))
    groups = [Group(_label(*key), key[0], sorted(found[key], key=lambda run: run.config.seed)) for key in keys]
    return groups + [Group(each.name, each.condition, [each], is_trained=False) for each in baselines]


def thesis_groups(groups: Sequence[Group]) -> dict[str, Group]:
    """Returns the group of each of the thesis's conditions, with the settings that most runs have."""
    return {each.condition: each for each in groups if each.is_trained and each.label == each.condition}


def _settings_apart(run: Judged, judged: Sequence[Judged]) -> tuple[str, ...]:
    """Returns the settings of a run, as `key value`, in which it differs from most of the runs."""
    apart: dict[str, list[str]] = {}
    for other in judged:
        for line in differences(run.config, other.config):
            key, _, values = line.partition(": ")
            if not any(fnmatch(key, pattern) for pattern in DIFFERENT_ANYWAY):
                apart.setdefault(key, []).append(values.partition(" | ")[0])
    most = len(judged) / 2
    return tuple(f"{key} {values[0]}" for key, values in sorted(apart.items()) if len(values) >= most)


def _label(condition: str, others: tuple[str, ...]) -> str:
    return f"{condition} ({', '.join(others)})" if others else condition
