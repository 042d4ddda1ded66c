"""What a report is made of: runs judged from the same starts, their flights step by step, and how they were trained.

`judge` flies the best policy of a run and keeps the outcome in `evaluation/reproduction.json` (one record a flight) and
`reproduction.npz` (where each flight went). A run that was judged in the same way before is not flown again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from apex_bat.config import Config
from apex_bat.evaluation import runs
from apex_bat.evaluation.baselines import BASELINES, make_baseline
from apex_bat.evaluation.flights import FlightRecord, fly
from apex_bat.recording.flight import Flight
from apex_bat.storage import StorageError, read_arrays, read_json, write_arrays, write_text

ARENAS = ("simple", "narrow", "circle")
"""Where the thesis evaluates. That these shipped arenas are its arenas is inferred."""
NAME = "reproduction"
"""Stem of the files that an evaluation for a report leaves."""
FLIGHTS_VERSION = 2
"""Of the code that flies. Raise it when the same policy would fly another way: motion, rays, ear, arenas, starts, the
ILD pilot or the oracle. Flights that were kept under another number are flown anew."""


class Protocol(NamedTuple):
    """How policies are judged: the same for all that are compared."""

    arenas: tuple[str, ...] = ARENAS
    num_flights: int = 15
    """In each arena (thesis: 15)."""
    start_seed: int = 20_200
    """Seed of the start poses."""


class Trace(NamedTuple):
    """Where a flight went."""

    poses: NDArray[np.float32]
    """(steps + 1, 3): x in m, y in m, heading in rad."""
    clearance_m: NDArray[np.float32]
    """(steps,): distance to the nearest wall after each step."""
    actions: NDArray[np.uint8]
    """(steps,): 0 straight, 1 left, 2 right."""


class Curve(NamedTuple):
    """How the judged checkpoints of a training fared; one row an evaluation."""

    env_steps: NDArray[np.float64]
    """Environment steps when the evaluation ended."""
    completed_share: NDArray[np.float64]
    progress_m: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Judged:
    """A trained policy or a baseline, and how it flew."""

    name: str
    """Of the run folder or of the baseline."""
    condition: str
    config: Config
    records: list[FlightRecord]
    traces: list[Trace]
    """One for each record, in the same order."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Of the training: seed, commit, host, times, size; empty of a baseline."""
    curve: Curve | None = None

    @property
    def num_judged(self) -> int:
        """Checkpoints that flew during the training; 0 of a baseline."""
        return 0 if self.curve is None else len(self.curve.env_steps)

    def of_arena(self, arena: str) -> list[tuple[FlightRecord, Trace]]:
        """Returns the flights in one arena."""
        pairs = zip(self.records, self.traces, strict=True)
        return [(record, trace) for record, trace in pairs if record.arena == arena]

    def scores(self, arenas: Sequence[str], value: Callable[[FlightRecord], float]) -> NDArray[np.float64]:
        """Returns a number of each flight: float64 (arenas, flights)."""
        return np.array([[value(record) for record, _ in self.of_arena(arena)] for arena in arenas], np.float64)


def judge(folder: Path, protocol: Protocol) -> Judged:
    """Flies the best policy of a run, or reads what was flown before, and returns the outcome.

    Raises:
        RunError: the folder holds no run or no checkpoint.
        StorageError: something of it cannot be read or written.
    """
    config = runs.load_config(folder)
    stem = folder / "evaluation" / NAME
    checkpoint = runs.best_checkpoint(folder)
    key = _key(protocol, checkpoint=hashlib.sha256(checkpoint.read_bytes()).hexdigest())
    found = _read(stem, key)
    if found is None:
        result, flights = runs.evaluate(
            folder, protocol.arenas, protocol.num_flights, protocol.start_seed, num_recorded=protocol.num_flights,
            path=checkpoint,
        )  # fmt: skip
        _write(stem, key, result, flights)
        found = _read(stem, key)
    assert found is not None  # noqa: S101
    result, records, traces = found
    known = read_json(folder / "run.json") if (folder / "run.json").exists() else {}
    facts = runs.training_facts(folder, config) | {"checkpoint_step": result["learner_step"]}
    facts |= {name: known.get(name) for name in ("host", "platform", "reason", "resumed")}
    first_replay = "replay" if config.replay.shards == 1 else "replay-0"
    facts["samples_per_insert"] = _last(folder, first_replay, "replay.samples_per_insert")
    return Judged(folder.name, config.condition, config, records, traces, facts, read_curve(folder))


def judge_baseline(name: str, config: Config, folder: Path, protocol: Protocol) -> Judged:
    """Does the same for a baseline, which flies with the body, rays and ear of `config`; files go to `folder`.

    Raises:
        ConfigError: there is no such baseline.
        StorageError: the files cannot be written.
    """
    config = msgspec.structs.replace(
        config, condition="memory",
        evaluation=msgspec.structs.replace(config.evaluation, start_seed=protocol.start_seed),
    )  # fmt: skip
    world = msgspec.to_builtins((config.body, config.rays, config.sonar, config.sensing, config.episode))
    text = json.dumps([name, world], sort_keys=True)
    key = _key(protocol, world=hashlib.sha256(text.encode()).hexdigest())
    folder.mkdir(parents=True, exist_ok=True)
    found = _read(folder / name, key)
    if found is None:
        result, flights = fly_baseline(name, config, protocol)
        _write(folder / name, key, result, flights)
        found = _read(folder / name, key)
    assert found is not None  # noqa: S101
    return Judged(name, name, config, found[1], found[2])


def fly_baseline(name: str, config: Config, protocol: Protocol) -> tuple[dict[str, Any], list[Flight]]:
    """Returns the result of a baseline's flights, in the form of `runs.evaluate`, and all of them as recorded.

    Raises:
        ConfigError: there is no such baseline.
    """
    records: list[FlightRecord] = []
    flights: list[Flight] = []
    summaries = []
    for arena in protocol.arenas:
        flown, recorded = fly(
            make_baseline(name, config), config, arena, num_flights=protocol.num_flights, seed=protocol.start_seed,
            num_recorded=protocol.num_flights,
        )  # fmt: skip
        records += flown
        flights += recorded
        summaries.append(runs.summary(flown, arena))
    result = {
        "run": name, "checkpoint": None, "learner_step": None, "condition": config.condition,
        "rendering": config.sonar.rendering, "summary": summaries,
        "flights": [msgspec.to_builtins(record) for record in records],
    }  # fmt: skip
    return result, flights


def judge_baselines(config: Config, folder: Path, protocol: Protocol) -> list[Judged]:
    """Returns how all baselines fly."""
    return [judge_baseline(name, config, folder, protocol) for name in BASELINES]


def read_curve(folder: Path) -> Curve | None:
    """Returns how the checkpoints fared that the evaluator judged during a training; None without any."""
    rows, judged = [], 0.0
    for row in _metrics(folder, "evaluator"):
        step = row.get("learner_step")
        if step is None or "completed_share" not in row or step == judged:
            continue
        judged = step
        rows.append((row["env_steps_total"], row["completed_share"], row["progress_m"]))
    return Curve(*np.array(rows, np.float64).T) if rows else None


def _key(protocol: Protocol, **flown: str) -> dict[str, Any]:
    """Returns by what kept flights are known: how, what, and by which version of the code."""
    return {"protocol": list(protocol), "version": FLIGHTS_VERSION, **flown}


def _last(folder: Path, role: str, name: str) -> float | None:
    values = [row[name] for row in _metrics(folder, role) if name in row]
    return float(values[-1]) if values else None


def _metrics(folder: Path, role: str) -> list[dict[str, Any]]:
    path = folder / "metrics" / f"{role}.jsonl"
    if not path.exists():
        return []
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except ValueError as error:
        raise StorageError(f"{path}: torn or corrupted: {error}") from None


def _write(stem: Path, key: dict[str, Any], result: dict[str, Any], flights: Sequence[Flight]) -> None:
    """Writes traces, then the records that say that all is there."""
    order = {(record["arena"], record["flight"]): row for row, record in enumerate(result["flights"])}
    flights = sorted(flights, key=lambda flight: order[flight.facts.arena, flight.facts.episode])
    arrays = {
        "steps": np.array([flight.num_steps for flight in flights]),
        "poses": np.concatenate([flight.poses for flight in flights]).astype(np.float32),
        "clearance_m": np.concatenate([flight.clearance_m for flight in flights]),
        "actions": np.concatenate([flight.action for flight in flights]),
    }
    write_arrays(stem.with_suffix(".npz"), "traces", key, arrays)
    write_text(stem.with_suffix(".json"), json.dumps(result | {"key": key}, indent=1) + "\n")


def _read(stem: Path, key: dict[str, Any]) -> tuple[dict[str, Any], list[FlightRecord], list[Trace]] | None:
    """Returns what was written, or None where there is nothing, or nothing of this policy and protocol."""
    wanted = json.loads(json.dumps(key))
    try:
        result = read_json(stem.with_suffix(".json"))
        header, arrays = read_arrays(stem.with_suffix(".npz"), "traces")
        records = msgspec.convert(result["flights"], list[FlightRecord])
    except (StorageError, KeyError, msgspec.ValidationError):
        return None
    if result.get("key") != wanted or {name: header.get(name) for name in wanted} != wanted:
        return None
    ends = np.cumsum(arrays["steps"])
    traces = [
        Trace(
            arrays["poses"][end - steps + k : end + k + 1],
            arrays["clearance_m"][end - steps : end],
            arrays["actions"][end - steps : end],
        )
        for k, (steps, end) in enumerate(zip(arrays["steps"], ends, strict=True))
    ]
    return result, records, traces
