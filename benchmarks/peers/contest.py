"""Runs the contest: one training after another, seeds interleaved, and goes on where it was interrupted.

A result is kept as soon as its training was judged. Every training has the whole machine to itself; judging comes after
it and uses all cores.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from apex_bat.launching import ONE_THREAD
from apex_bat.storage import write_text
from benchmarks.peers import apex_bat_entry, notebook
from benchmarks.peers.judging import Judgement, judge_course, judges
from benchmarks.peers.notebook import Row
from benchmarks.peers.process_tree import ProcessTree, Sample
from benchmarks.peers.terms import ENOUGH, ROOT, Entry, Environment, terms
from benchmarks.peers.training import VERSIONS

PEERS = ROOT / ".peers"
LOOK_S = 2.0
GRACE_S = 30.0
"""How long a training may take to end after its budget; what it does then does not count."""
LATER_S = 60.0
"""Seconds of training between policies that are judged after one completed enough flights."""
LATE_S = 1.0
"""A row so little after the budget is the last one of it."""

Result = dict[str, Any]


class Options(NamedTuple):
    """What is asked for."""

    file: Path
    budgets_s: dict[Environment, float]
    every_s: float
    overrides: tuple[str, ...] = ()
    """Of the peers' own settings, KEY=NUMBER: a trial."""
    is_kept: bool = False
    """Whether the folders of trainings stay."""


class Start(NamedTuple):
    """One training of the contest."""

    entry: Entry
    environment: Environment
    seed: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.entry.name}-{self.environment}-seed_{self.seed}"


class PeerError(RuntimeError):
    """A training that failed or could not be started."""


def starts(entries: Sequence[Entry], environments: Sequence[Environment], num_seeds: int) -> list[Start]:
    """Returns all trainings in their order: each seed of all, then the next seed of all."""
    return [
        Start(entry, environment, seed)
        for seed in range(num_seeds)
        for environment in environments
        for entry in entries
        if environment in entry.environments
    ]


def load(file: Path) -> dict[str, Any]:
    """Returns what is in a file of results; no results if there is no file."""
    if not file.exists():
        return {"results": []}
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content


def is_done(start: Start, options: Options, results: Sequence[Result]) -> bool:
    """Whether a result for this training, with this budget and these settings, is there."""
    wanted = (start.entry.name, start.environment, start.seed, options.budgets_s[start.environment])
    return any(
        (result["entry"], result["environment"], result["seed"], result["budget_s"]) == wanted
        and result["overrides"] == list(options.overrides)
        for result in results
    )


def hold(all_starts: Sequence[Start], options: Options) -> Iterator[str]:
    """Runs what is not done yet and keeps each result; yields a line about each training.

    Raises:
        PeerError: the file holds results of other settings.
    """
    shared = json.loads(msgspec.json.encode(terms()))
    for start in all_starts:
        content = load(options.file)
        if content.get("terms", shared) != shared:
            raise PeerError(f"{options.file} holds results of other settings than configs/memory.toml has now: give "
                            "another file to --json, or put that one away")  # fmt: skip
        results = content["results"]
        if is_done(start, options, results):
            yield f"{start.name}: is there already"
            continue
        try:
            result = run(start, options)
        except PeerError as error:
            yield f"{start.name}: failed: {error}"
            continue
        content = {"machine": machine(), "terms": shared, "results": [*results, result]}
        options.file.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.file, json.dumps(content, indent=1) + "\n")
        yield f"{start.name}: {_line(result)}"


def run(start: Start, options: Options) -> Result:
    """Trains and judges.

    Raises:
        PeerError: the training failed.
    """
    folder = PEERS / "runs" / start.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    budget_s = options.budgets_s[start.environment]
    begin_unix_s = time.time()
    samples = _train(start, options, folder, budget_s)
    found = notebook.read(folder) if start.entry.is_peer else apex_bat_entry.rows(folder, begin_unix_s)
    rows = [row for row in found if row.wall_s <= budget_s + LATE_S]
    if not any(row.policy for row in rows):
        raise PeerError(f"it wrote no policy within {budget_s:g} s; see {folder / 'output.log'}")
    together = os.cpu_count() or 1
    files = {row.wall_s: folder / row.policy for row in rows if row.policy}
    with judges(terms(), together) as judge_all:
        judged = judge_course(files, ENOUGH, LATER_S, judge_all, together)
    result = result_of(start, options, rows, samples, judged, _versions(start.entry, folder))
    if not options.is_kept:
        shutil.rmtree(folder)
    return result


def result_of(
    start: Start,
    options: Options,
    rows: Sequence[Row],
    samples: Sequence[Sample],
    judged: dict[float, Judgement],
    versions: dict[str, str],
) -> Result:
    """Returns the figures of a training, ready for JSON: `report` tells what they are."""
    walls_s = [sample.wall_s for sample in samples]
    cpus_s = [sample.cpu_s for sample in samples]
    learning = [row for row in rows if row.updates > 0]
    first, last = (learning[0], learning[-1]) if learning else (rows[0], rows[-1])
    span_s = max(last.wall_s - first.wall_s, 1e-9)
    return {
        "entry": start.entry.name,
        "environment": start.environment,
        "seed": start.seed,
        "budget_s": options.budgets_s[start.environment],
        "every_s": options.every_s,
        "overrides": list(options.overrides),
        "commit": _commit(),
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions,
        "start_s": rows[0].wall_s,
        "steps_per_s": (last.env_steps - first.env_steps) / span_s,
        "updates_per_s": (last.updates - first.updates) / span_s,
        "memory_mb": max(sample.memory_mb for sample in samples),
        "curve": [
            {
                "wall_s": row.wall_s,
                "env_steps": row.env_steps,
                "updates": row.updates,
                "cpu_s": round(float(np.interp(row.wall_s, walls_s, cpus_s)), 2),
                "completed": judged[row.wall_s].completed if row.wall_s in judged else None,
                "progress_m": round(judged[row.wall_s].progress_m, 1) if row.wall_s in judged else None,
            }
            for row in rows
            if row.policy
        ],
    }


def machine() -> dict[str, Any]:
    """Returns what the contest runs on."""
    model = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(encoding="utf-8").splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    return {"processor": model, "cores": os.cpu_count(), "python": platform.python_version()}


def _train(start: Start, options: Options, folder: Path, budget_s: float) -> list[Sample]:
    """Runs a training to its end; returns what its processes used."""
    begin_s = time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="peer-", ignore_cleanup_errors=True) as passing,
        (folder / "output.log").open("w", encoding="utf-8") as log,
    ):
        process = subprocess.Popen(
            _command(start, options, folder, begin_s), stdout=log, stderr=log, cwd=ROOT, start_new_session=True,
            env=os.environ | dict.fromkeys(ONE_THREAD, "1") | {"PYTHONPATH": str(ROOT), "TMPDIR": passing},
        )  # fmt: skip
        tree = ProcessTree(process.pid)
        is_asked = False
        try:
            while process.poll() is None:
                wall_s = time.monotonic() - begin_s
                tree.look(wall_s)
                if wall_s >= budget_s and not (is_asked or start.entry.is_peer):
                    process.send_signal(signal.SIGINT)
                    is_asked = True
                if wall_s >= budget_s + GRACE_S:
                    break
                time.sleep(LOOK_S if wall_s + LOOK_S < budget_s else 0.2)
        finally:
            tree.end(5.0)
            process.wait()
    if time.monotonic() - begin_s < budget_s:
        raise PeerError(f"it ended early with code {process.returncode}; see {folder / 'output.log'}")
    return tree.samples


def _command(start: Start, options: Options, folder: Path, begin_s: float) -> list[str]:
    entry, budget_s = start.entry, options.budgets_s[start.environment]
    if not entry.is_peer:
        return apex_bat_entry.command(entry, start.seed, folder, budget_s, options.every_s)
    python = PEERS / entry.name / "bin" / "python"
    if not python.exists():
        raise PeerError(f"{python} is missing; `make peers` installs it")
    arguments = {
        "--environment": start.environment, "--seed": start.seed, "--folder": folder, "--begin-s": begin_s,
        "--budget-s": budget_s, "--every-s": options.every_s,
    }  # fmt: skip
    command = [str(python), "-m", "benchmarks.peers.training", entry.name]
    for name, value in arguments.items():
        command += [name, str(value)]
    for override in options.overrides:
        command += ["--set", override]
    return command


def _versions(entry: Entry, folder: Path) -> dict[str, str]:
    if entry.is_peer:
        versions: dict[str, str] = json.loads((folder / VERSIONS).read_text(encoding="utf-8"))
        return versions
    return {package: metadata.version(package) for package in entry.packages}


def _line(result: Result) -> str:
    judged = [point for point in result["curve"] if point["completed"] is not None]
    enough = next((point["wall_s"] for point in judged if point["completed"] >= ENOUGH), None)
    when = f"{ENOUGH} of 15 after {enough:.0f} s" if enough is not None else f"never {ENOUGH} of 15"
    return (
        f"{when}, {judged[-1]['completed']} at the end; {result['steps_per_s']:.0f} steps/s, "
        f"{result['updates_per_s']:.1f} updates/s, {result['memory_mb']:.0f} MB"
    )


def _commit() -> str | None:
    """Returns the commit of the checkout, with a plus if it was changed."""
    try:
        commit = _git("rev-parse", "HEAD")
        return commit + ("+" if _git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(ROOT), *arguments]
    return subprocess.run(command, capture_output=True, check=True, text=True, timeout=5.0).stdout.strip()
