"""How fast the simulation is: the obvious way, one bat, 16 bats, and where the time of 16 bats goes.

CPU seconds are counted: steps per second of one core, whatever else the machine does. The measuring runs in a process
of its own with one thread, for threads of the linear algebra that wait for work would be counted too. The three ways
take turns, so that a slow spell meets them all.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.vector import EchoFlightVector
from benchmarks.obvious_environment import ObviousEnvironment

RUNS = 5
OBVIOUS_STEPS, VECTOR_STEPS = 40, 150
MANY = 16
START = (3.811 + 0.477, 0.0, np.pi / 2)  # from here circles to the left stay clear of the walls of simple

Record = dict[str, str | float | int]


def measure() -> list[Record]:
    """Returns a record {"name", "unit", "median", "min", "max", "runs"} for each figure, measured in a new process."""
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, "-m", "benchmarks.simulation"]
    done = subprocess.run(
        command, env=os.environ | one_thread, stdout=subprocess.PIPE, text=True, check=True, timeout=600
    )
    records: list[Record] = json.loads(done.stdout.splitlines()[-1])
    return records


def measure_here() -> list[Record]:
    """Returns the same, measured in this process."""
    figures: dict[str, list[float]] = {}
    obvious = ObviousEnvironment(load_arena("simple"), START)
    single, many = EchoFlightVector(1), EchoFlightVector(MANY)
    stages = _watch(many)
    try:
        for env in (single, many):
            env.reset(seed=1)
            _fly(env, 20)
        for _ in range(RUNS):
            rates = {
                "obvious": _rate(lambda: _circle(obvious), OBVIOUS_STEPS),
                "single": _rate(lambda: _fly(single, VECTOR_STEPS), VECTOR_STEPS),
            }
            stages.clear()
            rates["sixteen"] = _rate(lambda: _fly(many, VECTOR_STEPS), VECTOR_STEPS * MANY)
            for name, rate in rates.items():
                figures.setdefault(f"simulation.{name}.steps_per_s", []).append(rate)
            figures.setdefault("simulation.ratio", []).append(rates["sixteen"] / rates["obvious"])
            for stage, seconds in _stage_times_s(stages, 1.0 / rates["sixteen"]).items():
                figures.setdefault(f"simulation.stage.{stage}_us", []).append(1e6 * seconds)
    finally:
        obvious.close()
        single.close()
        many.close()
    return [_record(name, values) for name, values in figures.items()]


def _rate(work: Callable[[], None], steps: int) -> float:
    """Returns steps per CPU second."""
    begin_s = time.process_time()
    work()
    return steps / (time.process_time() - begin_s)


def _circle(env: ObviousEnvironment) -> None:
    for _ in range(OBVIOUS_STEPS):
        env.step(1)


def _fly(env: EchoFlightVector, steps: int) -> None:
    """Flies random actions, three of five straight; episodes begin anew where they end."""
    generator = np.random.default_rng(0)
    for _ in range(steps):
        env.step(generator.choice(3, size=env.num_envs, p=(0.6, 0.2, 0.2)))


def _watch(env: EchoFlightVector) -> dict[str, float]:
    """Returns a dictionary in which the CPU seconds of each stage add up from now on."""
    spent_s: dict[str, float] = {}
    colony: Any = env.colony

    def timed(stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*arguments: Any) -> Any:
            begin_s = time.process_time()
            result = work(*arguments)
            spent_s[stage] = spent_s.get(stage, 0.0) + time.process_time() - begin_s
            return result

        return watched

    colony.sensors.measure = timed("rays", colony.sensors.measure)
    colony.ears = SimpleNamespace(frames=timed("ear", colony.ears.frames))
    colony.world.fly = timed("world", colony.world.fly)
    colony._restart = timed("starts", colony._restart)
    return spent_s


def _stage_times_s(spent_s: dict[str, float], whole_s: float) -> dict[str, float]:
    """Returns the seconds of each stage, and of the rest, a bat and step."""
    each = {stage: seconds / (VECTOR_STEPS * MANY) for stage, seconds in spent_s.items()}
    return {**each, "rest": whole_s - sum(each.values())}


def _record(name: str, values: list[float]) -> Record:
    unit = "us" if name.endswith("_us") else "1/s" if name.endswith("_per_s") else "1"
    return {
        "name": name,
        "unit": unit,
        "median": statistics.median(values),
        "min": min(values),
        "max": max(values),
        "runs": len(values),
    }


if __name__ == "__main__":
    print(json.dumps(measure_here()))
