"""What recording costs: an actor with and without it, a file, a step, a heavy step, and bytes.

CPU seconds are counted, in a process of its own with one thread, as an actor has. The actor's bats fly on whatever
they touch, so that each episode has its full 300 steps, which are the dearest to record.

Run it with `apex-bat bench recording` or `python -m benchmarks.recording`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from apex_bat.agent.inference import parameter_shapes
from apex_bat.config.settings import Config, Episode
from apex_bat.experience import Chunk
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.flight import Flight
from apex_bat.recording.hearing import Directions
from apex_bat.recording.reading import read_flight
from apex_bat.roles.actor import Actor
from apex_bat.roles.plan import Addresses, Assignment, Role
from apex_bat.roles.reporting import RoleReporter
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.rays import ray_angles
from apex_bat.transport.messages import Weights
from benchmarks.replay import Record, summary

RUNS = 5
NEVER = 1_000_000
FEW_STEPS = 5


def measure() -> list[Record]:
    """Returns the records that `apex-bat bench recording` writes, measured in a new process with one thread."""
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, "-m", "benchmarks.recording"]
    done = subprocess.run(
        command, env=os.environ | one_thread, stdout=subprocess.PIPE, text=True, check=True, timeout=600
    )
    records: list[Record] = json.loads(done.stdout.splitlines()[-1])
    return records


def measure_here() -> list[Record]:
    """Returns the same, measured in this process."""
    config = msgspec.structs.replace(Config(), episode=Episode(max_damage=NEVER, max_idle=NEVER))
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "recordings").mkdir()
        overheads = _overheads(config, Path(folder))
        (path,) = (Path(folder) / "recordings").glob("*.rrd")
        return [summary("recording.overhead", "1", overheads), *_files(config, read_flight(path), Path(folder))]


def _overheads(config: Config, folder: Path) -> list[float]:
    """Shares of an actor's steps/s at the default setting.

    Every episode is recorded here and the cost divided by how seldom one is at the default: measured directly, it
    would drown in the noise.
    """
    default = config.recording.every_episodes
    always = msgspec.structs.replace(config.recording, every_episodes=1)
    never = msgspec.structs.replace(config.recording, every_episodes=0)
    shares = []
    for _ in range(RUNS):  # in turns, so that a slow spell meets both
        without_s, with_s = (
            _fly_s(msgspec.structs.replace(config, recording=each), folder) for each in (never, always)
        )
        added = (with_s / without_s - 1.0) / default
        shares.append(added / (1.0 + added))
    return shares


def _fly_s(config: Config, folder: Path) -> float:
    """CPU seconds of an actor for one episode of all its bats."""
    addresses = Addresses(*(f"ipc://{folder}/{name}" for name in ("replay", "weights", "reports")))
    assignment = Assignment(Role("actor", 0), config, folder, addresses, threading.Event(), 0)
    with closing(RoleReporter(assignment)) as reporter:
        actor = Actor(assignment, _NoReplay(), _SomeWeights(config), reporter)
        with closing(actor):
            actor.is_ready(0.0)
            begin_s = time.process_time()
            for _ in range(config.episode.training_steps):
                actor.step()
            return time.process_time() - begin_s


def _files(config: Config, flight: Flight, folder: Path) -> list[Record]:
    """Cost and size of recordings of the same flight: short, without and with the heavy entities."""
    few = _beginning(flight, FEW_STEPS)
    light = replace(flight, ranges_m=None)
    costs: dict[str, list[float]] = {}
    sizes: dict[str, int] = {}
    for _ in range(RUNS):
        for name, each in (("few", replace(few, ranges_m=None)), ("light", light), ("whole", flight)):
            begin_s = time.process_time()
            path = folder / f"{name}.rrd"
            write_flight(each, load_arena(config.arena), config.sonar, Directions(*ray_angles(config.rays)), path)
            costs.setdefault(name, []).append(1e3 * (time.process_time() - begin_s))
            sizes[name] = path.stat().st_size
    num_steps, num_heavy = flight.num_steps, len(flight.heavy_steps)
    steps_ms = np.array(costs["light"]) - np.array(costs["few"])
    heavy_ms = np.array(costs["whole"]) - np.array(costs["light"])
    return [
        summary("recording.file_ms", "ms", costs["few"]),
        summary("recording.step_us", "us", (1e3 * steps_ms / (num_steps - FEW_STEPS)).tolist()),
        summary("recording.heavy_step_ms", "ms", (heavy_ms / num_heavy).tolist()),
        summary("recording.cost_per_step_ms", "ms", (np.array(costs["whole"]) / num_steps).tolist()),
        summary("recording.file_bytes", "B", [float(sizes["few"])]),
        summary("recording.heavy_step_bytes", "B", [(sizes["whole"] - sizes["light"]) / num_heavy]),
        summary("recording.bytes_per_step", "B", [sizes["whole"] / num_steps]),
    ]


def _beginning(flight: Flight, num_steps: int) -> Flight:
    """The first steps of a flight."""
    rows: dict[str, Any] = {
        name: values[:num_steps] for name, values in vars(flight).items() if isinstance(values, np.ndarray)
    }
    return replace(flight, **rows | {"poses": flight.poses[: num_steps + 1]})


class _NoReplay:
    """Takes every chunk and forgets it."""

    waiting = ""
    has_room = True

    def send(self, chunks: Sequence[Chunk], learner_step: int) -> None:
        """Forgets."""

    def poll(self, timeout_s: float) -> None:
        """Has nothing to handle."""

    def flush(self, timeout_s: float) -> bool:
        """Has stored nothing, and never will."""
        return timeout_s >= 0.0

    def counters(self) -> dict[str, float]:
        """Counts nothing."""
        return {}

    def close(self) -> None:
        """Holds nothing."""


class _SomeWeights:
    """Gives random weights, once."""

    def __init__(self, config: Config) -> None:
        generator = np.random.default_rng(0)
        shapes = parameter_shapes(config.network, config.state_steps)
        arrays = {name: 0.1 * generator.standard_normal(shape, np.float32) for name, shape in shapes.items()}
        self._weights: Weights | None = Weights(1, 1, arrays)

    def newest(self) -> Weights | None:
        """Returns the weights the first time."""
        weights, self._weights = self._weights, None
        return weights

    def wait(self, timeout_s: float) -> bool:
        """Never waits."""
        return timeout_s >= 0.0

    def close(self) -> None:
        """Holds nothing."""


if __name__ == "__main__":
    print(json.dumps(measure_here()))
