"""Why runs cannot be compared: with the thesis, or with one another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatch

from apex_bat.evaluation import statistics
from apex_bat.evaluation.groups import Group
from apex_bat.evaluation.results import ARENAS, Judged, Protocol

NUM_FLIGHTS, NUM_STEPS = 15, 1000
"""Flights in each arena, and their longest, of the thesis."""
MOST_UNEQUAL_TRAINING = 1.05
"""Runs whose environment steps or updates differ by a greater factor are not compared."""
WORLD = ("arena", "body.*", "rays.*", "sonar.*", "sensing.*", "episode.*")
"""Settings of the thesis's experiment; the default has its values (a test compares them with configs/thesis.toml)."""
SAME_WORLD = ("rays.caster",)
"""Those that give the same rays by other code."""


def obstacle(names: Sequence[str], groups: Mapping[str, Group], protocol: Protocol) -> str:
    """Returns why these conditions cannot be compared with the thesis; empty if they can."""
    missing = [name for name in names if name not in groups]
    if missing:
        return f"{' and '.join(missing)} not trained with the settings that are judged"
    longest = max(run.config.episode.evaluation_steps for name in names for run in groups[name].runs)
    flights = (sorted(protocol.arenas), protocol.num_flights, longest)
    if flights != (sorted(ARENAS), NUM_FLIGHTS, NUM_STEPS):
        return "other flights than the thesis's"
    elsewhere = {line: None for name in names for line in groups[name].others if _is_of_world(line)}
    if elsewhere:
        return f"another experiment than the thesis's: {', '.join(elsewhere)}"
    few = [f"{name} {groups[name].num_seeds}" for name in names if groups[name].num_seeds < statistics.ENOUGH_SEEDS]
    if few:
        return f"fewer than {statistics.ENOUGH_SEEDS} seeds ({', '.join(few)})"
    return unequal_training([run for name in names for run in groups[name].runs])


def unequal_training(runs: Sequence[Judged]) -> str:
    """Returns how far runs are from having been trained alike long; empty if they were, as far as is known."""
    cut = [f"{run.name} {run.facts.get('outcome') or 'unknown'}" for run in runs if not _is_completed(run)]
    if cut:
        return f"trainings that did not reach their end: {', '.join(cut)}"
    for what, words in (("env_steps", "steps"), ("learner_steps", "updates")):
        trained = [run.facts.get(what) for run in runs]
        known = [number for number in trained if number is not None]
        if len(known) < len(trained):
            names = [run.name for run, number in zip(runs, trained, strict=True) if number is None]
            return f"unknown for how many {words} {', '.join(names)} trained"
        if min(known) * MOST_UNEQUAL_TRAINING < max(known):
            return f"trained for {min(known):,} to {max(known):,} {words}"
    return ""


def _is_completed(run: Judged) -> bool:
    return run.facts.get("outcome") == "completed"


def _is_of_world(line: str) -> bool:
    key = line.partition(" ")[0]
    return key not in SAME_WORLD and any(fnmatch(key, pattern) for pattern in WORLD)
