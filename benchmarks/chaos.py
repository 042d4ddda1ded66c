"""Chaos: a real training run whose roles are killed and stopped at random while it learns; what it costs and loses.

    python -m benchmarks.chaos --minutes 10 --period 10 --seed 0 --json docs/results/chaos.json

Every period one fault of a seeded schedule hits a role that has recovered from the last: SIGKILL of an actor, the
replay server, the learner or the evaluator, of two of them at once, SIGSTOP (which only the missing heartbeat tells),
SIGKILL of the learner while it writes a checkpoint and of the replay while it writes a snapshot. In a second, short run
the launcher itself is killed. `benchmarks.chaos_report` judges what came of it. POSIX only.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from apex_bat.roles.resources import began_unix_s
from benchmarks import chaos_report
from benchmarks.chaos_report import END_MARGIN_PERIODS, Course, Fault, Sample, Timeline, is_flowing

KINDS = (
    "kill actor", "kill replay", "kill learner", "kill evaluator", "kill two", "stop one", "kill in checkpoint",
    "kill in snapshot",
)  # fmt: skip
CHAOS_SETTINGS = (
    "actors=2", "launch.heartbeat_timeout_s=5.0", "checkpoint.period_s=10.0", "replay.snapshot_period_s=20.0",
)  # fmt: skip
"""What differs from the configuration: as many actors on any machine, of which one flies on while the other is hit;
hangs are noticed sooner, and files are written often enough to be hit."""
LOOK_S, WATCH_S = 0.05, 0.0005
"""Time between looks at status.json, and at a folder in which a file is about to be written."""
WARM_UP_S = 10.0
"""Undisturbed flight before the first fault."""
WATCH_FOR_S = 40.0
START_S, FLOW_PERIODS = 180.0, 10.0
"""How long all roles may take until they work, at the start, and after a fault, in periods of the schedule."""
END_S = 600.0
"""How long the evaluation after training may take."""


class Options(NamedTuple):
    """What is asked for."""

    config: str | None
    settings: tuple[str, ...]
    minutes: float
    period_s: float
    seed: int


def schedule(generator: random.Random) -> Iterator[str]:
    """Yields kinds of faults for ever: each once in random order, and again in another."""
    while True:
        yield from generator.sample(KINDS, len(KINDS))


def victims(kind: str, roles: Sequence[str], generator: random.Random) -> list[str]:
    """Returns the names of the roles that a fault of a kind hits."""
    actors = [name for name in roles if name.startswith("actor")]
    if kind == "kill two":
        return generator.sample(list(roles), 2)
    if kind == "stop one":
        return [generator.choice(list(roles))]
    if kind == "kill actor":
        return [generator.choice(actors)]
    return [{"kill in checkpoint": "learner", "kill in snapshot": "replay"}.get(kind, kind.removeprefix("kill "))]


class Run:
    """A training run as a subprocess, and what its status.json said from the beginning."""

    def __init__(self, folder: Path, options: Options, minutes: float) -> None:
        self.folder, self.timeline = folder, Timeline()
        command = [sys.executable, "-m", "apex_bat", "train", "--plain", "--run", str(folder)]
        command += ["--config", options.config] if options.config else []
        for setting in (*options.settings, f"train.max_minutes={minutes}"):
            command += ["--set", setting]
        self.output = folder.with_suffix(".out").open("w")
        self.process = subprocess.Popen(command, stdout=self.output, stderr=self.output, start_new_session=True)

    def look(self) -> Sample | None:
        """Notes what the status says now, if it says something new."""
        try:
            content = json.loads((self.folder / "status.json").read_text())
        except (OSError, ValueError):
            return None
        return self.timeline.take(content, time.time())

    def roles(self) -> list[str]:
        """Returns the names of all roles; none before the first status."""
        newest = self.timeline.newest
        return [] if newest is None else [*newest.roles]

    def pid(self, role: str) -> int | None:
        """Returns the present process of a role."""
        newest = self.timeline.newest
        return None if newest is None else newest.roles[role]["pid"]

    def look_until(self, ends_s: float) -> None:
        """Goes on noting until a time by time.time(), or until the run is over."""
        while time.time() < ends_s and self.process.poll() is None:
            self.look()
            time.sleep(LOOK_S)

    def all_flow(self) -> bool:
        """Whether every role works."""
        newest = self.timeline.newest
        return newest is not None and all(is_flowing(name, self.timeline) for name in newest.roles)

    def wait_for_flow(self, within_s: float) -> bool:
        """Waits until every role works; says whether they do."""
        ends_s = time.time() + within_s
        while not self.all_flow() and time.time() < ends_s and self.process.poll() is None:
            self.look_until(time.time() + LOOK_S)
        return self.all_flow()

    def end(self) -> None:
        """Makes sure that nothing of it is left, whatever went wrong."""
        pids = [row["pid"] for sample in self.timeline.samples[-1:] for row in sample.roles.values() if row["pid"]]
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
            for pid in pids:
                if began_unix_s(pid) is not None:
                    os.kill(pid, signal.SIGKILL)
        self.output.close()


def inject(run: Run, kind: str, names: Sequence[str]) -> Fault | None:
    """Does a fault; None if there was nobody to hit, or no file was being written."""
    pids = [run.pid(name) for name in names]
    if any(pid is None or began_unix_s(pid) is None for pid in pids):
        return None
    if kind in ("kill in checkpoint", "kill in snapshot") and not _wait_for_file(run, kind):
        return None
    run.look()
    snapshot = run.folder / "replay" / "replay.snapshot"
    saved_unix_s = snapshot.stat().st_mtime if snapshot.exists() else None
    for pid in pids:
        os.kill(pid or 0, signal.SIGSTOP if kind == "stop one" else signal.SIGKILL)
    return Fault(kind, tuple(names), tuple(pid or 0 for pid in pids), time.time(), saved_unix_s)


def _wait_for_file(run: Run, kind: str) -> bool:
    """Watches until a checkpoint or a snapshot is half written."""
    folder, end = ("checkpoints", ".part") if kind == "kill in checkpoint" else ("replay", ".writing")
    ends_s = time.time() + WATCH_FOR_S
    while time.time() < ends_s and run.process.poll() is None:
        for _ in range(200):
            if any(entry.name.endswith(end) and "best" not in entry.name for entry in os.scandir(run.folder / folder)):
                return True
            time.sleep(WATCH_S)
        run.look()
    return False


def disturb(run: Run, options: Options) -> Course:
    """Hits roles until the training is nearly over, or until they do not work again; returns how it went."""
    generator = random.Random(options.seed)  # noqa: S311  # a schedule, no secret
    faults: list[Fault] = []
    kinds = schedule(generator)
    if not run.wait_for_flow(START_S):
        return Course(faults, options.period_s, f"not all roles worked within {START_S:g} s of the start")
    began_s = time.time()
    run.look_until(began_s + min(WARM_UP_S, options.period_s))
    while run.process.poll() is None:
        if time.time() - began_s > 60.0 * options.minutes - END_MARGIN_PERIODS * options.period_s:
            break  # the last fault is recovered from before the end, so that its time can be measured
        if not run.wait_for_flow(FLOW_PERIODS * options.period_s):
            if run.process.poll() is not None:  # it ended meanwhile; whether as asked, its exit code tells
                break
            return Course(faults, options.period_s, f"not all roles worked again after {time.time() - began_s:.0f} s")
        kind = next(kinds)
        names = victims(kind, run.roles(), generator)
        fault = inject(run, kind, names)
        if fault is not None:
            faults.append(fault)
            print(f"{time.time() - began_s:6.1f} s  {kind}: {', '.join(names)}", flush=True)
        run.look_until(time.time() + options.period_s)
    return Course(faults, options.period_s, "")


def train_disturbed(folder: Path, options: Options) -> dict[str, Any]:
    """Runs the training with its faults and returns what came of it."""
    run = Run(folder, options, options.minutes)
    try:
        course = disturb(run, options)
        run.look_until(time.time() + 60.0 * options.minutes + END_S)
        return chaos_report.report(folder, run.timeline, course, run.process.poll())
    finally:
        run.end()


def kill_launcher(folder: Path, options: Options) -> dict[str, Any]:
    """Kills the launcher of another run and returns how long its roles live on, in s, and what they leave."""
    run = Run(folder, options, 5.0)
    try:
        run.wait_for_flow(START_S)
        has_children = len(chaos_report.processes_of(folder)) > 1
        run.process.kill()
        run.process.wait()
        killed_s = time.time()
        while chaos_report.processes_of(folder) and time.time() < killed_s + 60.0:
            time.sleep(LOOK_S)
        return {
            "roles_ended_after_s": round(time.time() - killed_s, 2) if has_children else float("nan"),
            "processes": chaos_report.processes_of(folder),
            "leftovers": chaos_report.leftovers_of(folder, run.process.pid),
        }
    finally:
        run.end()


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, prints and writes; returns 0 if every check held."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="of training, from the first step [10]")
    parser.add_argument("--period", type=float, default=10.0, help="between faults, in s [10]")
    parser.add_argument("--seed", type=int, default=0, help="of the schedule [0]")
    parser.add_argument("--config", default="configs/memory.toml", help="settings [configs/memory.toml]")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change one setting")
    parser.add_argument("--json", type=Path, help="write the result to this file")
    parser.add_argument("--keep", type=Path, help="folder for the run folders, kept afterwards")
    given = parser.parse_args(arguments)
    options = Options(given.config or None, (*CHAOS_SETTINGS, *given.set), given.minutes, given.period, given.seed)
    folder = given.keep or Path(tempfile.mkdtemp(prefix="apex_bat-chaos-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        result = train_disturbed(folder / "run", options)
        result |= {"launcher_killed": kill_launcher(folder / "short", options)}
    finally:
        if given.keep is None:
            shutil.rmtree(folder, ignore_errors=True)
    result |= {"minutes": given.minutes, "period_s": given.period, "seed": given.seed, "cores": os.cpu_count(),
               "settings": [*options.settings], "config": given.config}  # fmt: skip
    killed = result["launcher_killed"]
    result["checks"] |= {
        "children of a killed launcher end within 10 s": killed["roles_ended_after_s"] <= 10.0,
        "they leave no process and no unfinished file": not killed["processes"] and not killed["leftovers"],
    }
    if given.json:
        given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(chaos_report.document(result))
    return 0 if all(result["checks"].values()) else 1


if __name__ == "__main__":
    raise SystemExit(main())
