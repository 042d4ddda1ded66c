"""The settings of runs that tests start: small enough to learn within seconds."""

from __future__ import annotations

from collections.abc import Mapping

SMALL: Mapping[str, str] = {
    "actors": "1", "bats_per_actor": "4", "replay.min_size": "200", "replay.capacity": "5_000",
    "replay.samples_per_insert": "2.0", "learner.batch_size": "16", "learner.weights_period": "5",
    "network.channels": "[4]", "network.strides": "[3]", "network.hidden": "[16]", "actor.chunk_transitions": "10",
    "evaluation.flights": "2", "evaluation.period_s": "1.0", "checkpoint.period_s": "1.0",
    "recording.evaluation_flights": "1", "episode.evaluation_steps": "40",
}  # fmt: skip


def options(settings: Mapping[str, str], **changes: str) -> list[str]:
    """Returns the words of a command for settings and their changes, whose names have `__` for each dot."""
    changed = {**settings, **{name.replace("__", "."): value for name, value in changes.items()}}
    return [word for name, value in changed.items() for word in ("--set", f"{name}={value}")]
