"""Run folders: making one, reading one, and judging the policy that it holds."""

from __future__ import annotations

import json
import platform
import socket
import subprocess
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from apex_bat import config as configuration
from apex_bat.agent.inference import Policy
from apex_bat.config import Config
from apex_bat.config.loading import differences
from apex_bat.roles import checkpoint
from apex_bat.storage import StorageError, read_json, write_text

if TYPE_CHECKING:
    from apex_bat.evaluation.flights import FlightRecord
    from apex_bat.recording.flight import Flight

FOLDERS = ("metrics", "checkpoints", "replay", "recordings", "evaluation", "figures", "logs")


class RunError(ValueError):
    """A run folder that is missing, in use, not empty, or cannot be written."""


def create(folder: Path, config: Config, mode: str = "asynchronous") -> None:
    """Makes a run folder with its settings and the facts of its start.

    Raises:
        RunError: the folder holds a run already or cannot be written.
    """
    if (folder / "run.json").exists():
        raise RunError(f"{folder}: holds a run already; name another folder with --run")
    try:
        for name in FOLDERS:
            (folder / name).mkdir(parents=True, exist_ok=True)
        write_text(folder / "config.toml", configuration.dumps(config))
        facts = {"start": _now(), "seed": config.seed, "host": socket.gethostname(), **_versions()}
        note(folder, outcome="running", mode=mode, **facts)
    except (OSError, StorageError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise RunError(f"{folder}: the run folder cannot be written: {reason}; name another with --run") from None


def note(folder: Path, **facts: Any) -> None:
    """Adds facts to the folder's run.json.

    Raises:
        StorageError: it cannot be written.
    """
    path = folder / "run.json"
    known = read_json(path) if path.exists() else {}
    write_text(path, json.dumps(known | facts, indent=2) + "\n")


def finish(folder: Path, outcome: str, **facts: Any) -> None:
    """Notes how a run ended."""
    note(folder, outcome=outcome, end=_now(), **facts)


def load_config(folder: Path) -> Config:
    """Returns the settings of a run.

    Raises:
        RunError: there is no run in the folder.
        ConfigError: its settings are not valid in this version.
    """
    if not (folder / "config.toml").exists():
        raise RunError(f"{folder}: no run here (config.toml is missing)")
    return configuration.load(folder / "config.toml")


def best_checkpoint(folder: Path) -> Path:
    """Returns the path of the best checkpoint, or of the newest if none was judged.

    Raises:
        RunError: there is none.
    """
    best = folder / "checkpoints" / checkpoint.BEST
    if best.exists():
        return best
    newest = checkpoint.find(folder / "checkpoints")[-1:]
    if not newest:
        raise RunError(f"{folder}: there is no checkpoint to evaluate")
    return newest[0]


def evaluate(
    folder: Path,
    arenas: Sequence[str],
    num_flights: int,
    seed: int,
    *,
    num_recorded: int = 0,
    path: Path | None = None,
    overrides: Sequence[str] = (),
) -> tuple[dict[str, Any], list[Flight]]:
    """Flies the best policy of a run and returns the result, ready for JSON, and the recorded flights.

    Args:
        folder: of the run.
        arenas: where to fly.
        num_flights: in each.
        seed: of the start poses.
        num_recorded: how many flights of each arena to log whole.
        path: the checkpoint; None: the best.
        overrides: changes to the settings that the policy was trained with, as `config.load` takes them.

    Raises:
        RunError: the folder holds no run or no checkpoint, or the policy does not fit the changed settings.
        StorageError: the checkpoint cannot be read.
        ConfigError: a change is not allowed.
    """
    from apex_bat.evaluation.flights import fly  # here: a launcher makes run folders and need not import a simulation

    trained = load_config(folder)
    config = configuration.load(folder / "config.toml", overrides) if overrides else trained
    path = path or best_checkpoint(folder)
    found = checkpoint.load(path)
    policy = Policy(config.network, config.state_steps)
    try:
        policy.load(found.policy_parameters())
    except ValueError as error:
        raise RunError(f"{path}: {error}") from None
    began_s = time.perf_counter()
    records: list[FlightRecord] = []
    summaries: list[dict[str, Any]] = []
    flights: list[Flight] = []
    for arena in arenas:
        flown, recorded = fly(
            policy, config, arena, num_flights=num_flights, seed=seed, num_recorded=num_recorded,
            checkpoint_step=found.learner_step,
        )  # fmt: skip
        records += flown
        summaries.append(summary(flown, arena))
        flights += recorded
    result = {
        "run": folder.name,
        "checkpoint": path.name,
        "learner_step": found.learner_step,
        "condition": config.condition,
        "rendering": config.sonar.rendering,
        "changed": differences(trained, config),
        "training": training_facts(folder, config),
        "evaluation_wall_s": round(time.perf_counter() - began_s, 3),
        "summary": summaries,
        "flights": [msgspec.to_builtins(record) for record in records],
    }
    return result, flights


def training_facts(folder: Path, config: Config) -> dict[str, Any]:
    """Returns what a reader of results wants to know of a run's training: seed, commit, times, size."""
    path = folder / "run.json"
    known = read_json(path) if path.exists() else {}
    facts = {name: known.get(name) for name in ("commit", "start", "end", "outcome", "env_steps", "learner_steps")}
    facts |= {"seed": config.seed, "actors": config.actors, "bats_per_actor": config.bats_per_actor}
    if facts["start"] and facts["end"]:
        try:
            elapsed = datetime.fromisoformat(str(facts["end"])) - datetime.fromisoformat(str(facts["start"]))
        except (ValueError, TypeError) as error:
            raise StorageError(f"{path}: start or end is no time: {error}") from None
        is_whole = not known.get("resumed")  # else there was a pause
        facts["wall_s"] = elapsed.total_seconds() if is_whole else known.get("elapsed_s")
    return facts


def summary(records: Sequence[FlightRecord], arena: str) -> dict[str, Any]:
    """Returns the figures of the flights in one arena."""
    return {
        "arena": arena,
        "flights": len(records),
        "completed": sum(record.completed for record in records),
        "steps_mean": float(np.mean([record.steps for record in records])),
        "distance_m_mean": float(np.mean([record.distance_m for record in records])),
        "progress_m_mean": float(np.mean([record.progress_m for record in records])),
        "straight_share_mean": float(np.mean([record.action_shares[0] for record in records])),
        "clearance_m_median": float(np.median([record.clearance_quantiles_m[3] for record in records])),
    }


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _versions() -> dict[str, Any]:
    packages = ("apex-bat", "gymnasium", "numpy", "pybullet", "pyzmq", "rerun-sdk", "torch")
    versions = {name: _version(name) for name in packages}
    return {"python": platform.python_version(), "platform": platform.platform(), "versions": versions,
            "commit": _commit()}  # fmt: skip


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """Returns the commit of the source tree, with a plus if it was changed; None outside a checkout."""
    source = Path(__file__).resolve().parent
    try:
        _git("ls-files", "--error-unmatch", "__init__.py", source=source)  # else it is somebody else's repository
        commit = _git("rev-parse", "HEAD", source=source)
        return commit + ("+" if _git("status", "--porcelain", source=source) else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(*arguments: str, source: Path) -> str:
    command = ["git", "-C", str(source), *arguments]
    return subprocess.run(command, capture_output=True, check=True, text=True, timeout=5.0).stdout.strip()  # noqa: S603
