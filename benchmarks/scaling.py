"""How a run scales: costs measured here, a model of queues fed with them, its predictions beside real runs and beyond.

Run it with `apex-bat bench scaling` or `python -m benchmarks.scaling`: 17 minutes on a machine that does nothing else.
`scaling_model` is the model, `scaling_page` makes docs/scaling.md of the records.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from apex_bat.config import Config, load
from apex_bat.replay.store import limiter_of
from benchmarks.replay import Record, summary
from benchmarks.scaling_costs import costs_of, measure_costs
from benchmarks.scaling_model import Costs, Outcome, Run, Simulation
from benchmarks.system import read_rows

ROUNDS = 3  # of all real runs: others on the machine slow one of them down
RUN_MINUTES = 0.5
SETTLED_S = 12.0  # of flight: rows before are left out, as further actors still start
SIMULATED_S = 60.0


class Setup(NamedTuple):
    """A run that is measured and predicted."""

    actors: int
    samples_per_insert: float

    @property
    def name(self) -> str:
        """Of its records, after `measured` or `predicted`."""
        return f"ratio_{self.samples_per_insert:g}.actors_{self.actors}"


SETUPS = (Setup(1, 8.0), Setup(2, 8.0), Setup(4, 8.0), Setup(8, 8.0), Setup(1, 0.5), Setup(8, 0.5))


class Rates(NamedTuple):
    """What a real run did."""

    steps_per_s: float
    updates_per_s: float
    samples_per_insert: float


class Scale(NamedTuple):
    """A run on more cores than there are here, predicted only."""

    cores: int
    servers: int
    speed: float
    """Of the learner, in learners of this machine's core."""
    ratio: float | None
    """Samples per insert; None: nobody waits for anybody."""
    batch_size: int = 64

    @property
    def name(self) -> str:
        """Of its records."""
        law = "free" if self.ratio is None else f"ratio_{self.ratio:g}"
        return (
            f"scaling.at.cores_{self.cores}.servers_{self.servers}.learner_x{self.speed:g}.{law}"
            f".batch_{self.batch_size}"
        )

    @property
    def actors(self) -> int:
        """Cores that the learner and the servers leave."""
        return self.cores - 1 - self.servers


SCALES = (
    Scale(10, 1, 1.0, 8.0), Scale(10, 1, 20.0, 8.0), Scale(10, 1, 1.0, None),
    Scale(100, 1, 20.0, 8.0), Scale(100, 4, 20.0, 8.0), Scale(100, 1, 20.0, 8.0, 512), Scale(100, 4, 20.0, 8.0, 512),
    Scale(100, 1, 20.0, 0.5), Scale(100, 1, 1.0, None), Scale(100, 2, 1.0, None),
    Scale(1000, 1, 20.0, 0.5), Scale(1000, 1, 1.0, None), Scale(1000, 8, 1.0, None), Scale(1000, 16, 1.0, None),
)  # fmt: skip


def measure() -> list[Record]:
    """Returns the records that `apex-bat bench scaling` writes."""
    records = measure_costs()
    costs = costs_of(records)
    cores = os.cpu_count() or 1
    rounds = [[_measured(setup) for setup in SETUPS] for _ in range(ROUNDS)]
    for setup, rates in zip(SETUPS, zip(*rounds, strict=True), strict=True):
        records += outcome_records(f"scaling.predicted.{setup.name}", predict(_config(setup), costs, cores))
        for field, unit, values in zip(Rates._fields, ("1/s", "1/s", "1"), zip(*rates, strict=True), strict=True):
            records.append(summary(f"scaling.measured.{setup.name}.{field}", unit, list(values)))
    return records + predictions(costs)


def predictions(costs: Costs) -> list[Record]:
    """Returns what the model says of runs on more cores."""
    records: list[Record] = []
    for scale in SCALES:
        duration_s = SIMULATED_S * min(1.0, 100.0 / scale.actors)
        faster = at_speed(costs, scale.speed)
        records += outcome_records(scale.name, Simulation(_run_at(scale), faster).outcome(duration_s))
    return records


def at_speed(costs: Costs, speed: float) -> Costs:
    """Returns the costs with a learner whose device is so many times as fast; its host is as fast as before."""
    return costs._replace(update_s=costs.update_s / speed, update_item_s=costs.update_item_s / speed)


def predict(config: Config, costs: Costs, cores: int | None, duration_s: float = SIMULATED_S) -> Outcome:
    """Returns what the model says of a run with some settings; `cores` for all of it, or one a process."""
    run = Run(
        config.actors, config.learner.batch_size, config.actor.chunk_transitions, config.replay.samples_per_insert,
        config.replay.min_size, limiter_of(config).error_buffer * config.replay.shards, config.actor.window_chunks,
        config.learner.prefetch, config.replay.shards, cores,
    )  # fmt: skip
    return Simulation(run, costs).outcome(duration_s)


def outcome_records(name: str, outcome: Outcome) -> list[Record]:
    """Returns an outcome as records."""
    units = ("1/s", "1/s", "1", "1", "1", "1")
    return [
        summary(f"{name}.{field}", unit, [value])
        for field, unit, value in zip(outcome._fields, units, outcome, strict=True)
    ]


def _config(setup: Setup) -> Config:
    return load(None, [f"actors={setup.actors}", f"replay.samples_per_insert={setup.samples_per_insert:g}"])


def _measured(setup: Setup) -> Rates:
    """Returns what a real run did between its first and last row that count."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        settings = {
            "actors": setup.actors, "replay.samples_per_insert": setup.samples_per_insert,
            "train.max_minutes": RUN_MINUTES, "evaluation.during_training": "false", "evaluation.arenas": "[]",
        }  # fmt: skip
        command = [sys.executable, "-m", "apex_bat", "train", "--plain", "--run", str(run)]
        for key, value in settings.items():
            command += ["--set", f"{key}={value}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        rows = {path.stem: read_rows(path, SETTLED_S) for path in (run / "metrics").glob("*.jsonl")}
    flown = [_rate(rows[f"actor-{number}"], "env_steps") for number in range(setup.actors)]
    replay = rows["replay"]
    inserted, sampled = _rate(replay, "replay.inserted"), _rate(replay, "replay.sampled")
    return Rates(sum(flown), _rate(rows["learner"], "updates"), sampled / inserted)


def _rate(rows: list[dict[str, Any]], name: str) -> float:
    rows = [row for row in rows if name in row]
    first, last = rows[0], rows[-1]
    return float(last[name] - first[name]) / float(last["unix_s"] - first["unix_s"])


def _run_at(scale: Scale) -> Run:
    config = Config()
    learner = msgspec.structs.replace(config.learner, batch_size=scale.batch_size)
    config = msgspec.structs.replace(config, learner=learner)
    ratio, band = scale.ratio or 8.0, float("inf")
    if scale.ratio is not None:
        replay = msgspec.structs.replace(config.replay, samples_per_insert=ratio, shards=scale.servers)
        band = limiter_of(msgspec.structs.replace(config, replay=replay)).error_buffer * scale.servers
    return Run(scale.actors, scale.batch_size, samples_per_insert=ratio, band=band, servers=scale.servers)


def table(records: Sequence[Record]) -> str:
    """Returns predicted beside measured, as text."""
    median = {str(record["name"]): float(record["median"]) for record in records}
    lines = [f"{'run':24}{'figure':20}{'predicted':>10}{'measured':>10}{'ratio':>7}"]
    for setup in SETUPS:
        for figure in ("steps_per_s", "updates_per_s", "samples_per_insert"):
            predicted = median[f"scaling.predicted.{setup.name}.{figure}"]
            measured = median[f"scaling.measured.{setup.name}.{figure}"]
            lines.append(f"{setup.name:24}{figure:20}{predicted:10.4g}{measured:10.4g}{predicted / measured:7.2f}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(measure()))
