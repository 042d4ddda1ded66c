"""Resuming a run: which settings may change, whether everything that it goes on from is there and sound, what it is.

Nothing is begun anew without a word: what is missing or torn is an error that says how to go on.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from apex_bat.agent.inference import AVERAGE, ONLINE, OPTIMISER, TARGET
from apex_bat.config import Config, ConfigError, dumps, load
from apex_bat.config.loading import differences
from apex_bat.evaluation.runs import RunError, load_config, note
from apex_bat.launching import serial_state
from apex_bat.launching.standing import Origin
from apex_bat.launching.status import STATUS
from apex_bat.replay.snapshot import SnapshotError, previous_of
from apex_bat.replay.store import ReplayStore
from apex_bat.replay.verification import SnapshotFacts, verify
from apex_bat.roles import checkpoint
from apex_bat.roles.plan import roles_of
from apex_bat.roles.replay import snapshot_of
from apex_bat.storage import StorageError, digest, read_json, write_text

Mode = Literal["asynchronous", "serial"]

MAY_CHANGE = (
    "train.*", "launch.*", "recording.*", "evaluation.*", "checkpoint.*", "transport.*", "device", "actors",
    "actor.window_chunks", "actor.weights_period", "replay.snapshot_period_s", "learner.learning_rate",
    "learner.weights_period", "learner.prefetch", "learner.compile",
)  # fmt: skip
"""When a run ends, how it is watched, how fast it learns. All else says what its experience, network and counters mean:
to change that is another experiment, and a new run."""
FIXED_IN_SERIAL = ("actors",)
"""Which of these the serial mode keeps: it continues each actor where it was."""
SHORT = 12  # digits of a hash that a person reads


class Continuation(NamedTuple):
    """What a run goes on from."""

    config: Config
    mode: Mode
    origin: Origin
    facts: dict[str, Any]
    """What is restored, for run.json."""
    lines: tuple[str, ...]
    """The same, for a person."""


def mode_of(run: Path) -> Mode:
    """Returns the mode in which a run was begun.

    Raises:
        RunError: there is no run in the folder, or its run.json is damaged.
    """
    return "serial" if _facts_of(run).get("mode") == "serial" else "asynchronous"


def num_resumed(run: Path) -> int:
    """Returns how often a run was resumed."""
    return len(_facts_of(run).get("resumed", []))


def prepare(
    run: Path, config_file: Path | None, overrides: Sequence[str], *, serial: bool, without_replay: bool
) -> Continuation:
    """Checks that a run can be resumed, changes nothing, and returns what it goes on from.

    Args:
        run: the run folder, which nobody else uses meanwhile.
        config_file: settings instead of those of the run; None: those of the run.
        overrides: changes to them.
        serial: whether the serial mode was asked for.
        without_replay: whether to begin with an empty replay.

    Raises:
        ConfigError: a setting changes that cannot, or the mode does not fit.
        RunError: there is no run, nothing to go on from, or its limits are reached.
        StorageError: what there is cannot be used; the text says what and how to go on.
    """
    old, mode = load_config(run), mode_of(run)
    if serial and mode != "serial":
        raise ConfigError(f"{run}: was begun without --serial and can only be resumed so")
    config = load(config_file or run / "config.toml", overrides)
    check_changes(old, config, mode)
    if mode == "serial" and without_replay:
        raise ConfigError("--without-replay: a serial run continues whole or not at all")
    found = _serial(run, config) if mode == "serial" else _asynchronous(run, config, without_replay=without_replay)
    _check_limits(run, found.config, found.origin)
    return found


def apply(run: Path, found: Continuation, *, without_replay: bool) -> None:
    """Notes in the run folder that it is resumed, and with which settings.

    The former config.toml stays as config.toml.N; a snapshot that is not wanted, as *.set-aside.

    Raises:
        StorageError: the folder cannot be written.
    """
    settings, text = run / "config.toml", dumps(found.config)
    try:
        former = settings.read_text(encoding="utf-8")
        if former != text:
            write_text(run / f"config.toml.{num_resumed(run) + 1}", former)
            write_text(settings, text)
        if without_replay:
            for newest in _snapshots_of(run, found.config).values():
                for path in (newest, previous_of(newest)):
                    if path.exists():
                        path.replace(path.with_name(path.name + ".set-aside"))
    except OSError as error:
        raise StorageError(f"{run}: cannot be written: {error.strerror or error}") from None
    entry = {"start": datetime.now(UTC).isoformat(timespec="seconds"), **found.facts}
    note(run, outcome="running", end=None, reason=None, resumed=[*_facts_of(run).get("resumed", []), entry])


def check_changes(old: Config, new: Config, mode: Mode) -> None:
    """Raises ConfigError, naming each, if settings differ that a resumed run must keep."""
    fixed = []
    for line in differences(old, new):
        name, _, values = line.partition(": ")
        is_free = any(fnmatch(name, pattern) for pattern in MAY_CHANGE)
        if not is_free or (mode == "serial" and name in FIXED_IN_SERIAL):
            was, _, is_now = values.partition(" | ")
            fixed.append(f"{name} was {was} and would be {is_now}")
    if fixed:
        raise ConfigError(
            f"a resumed run keeps its experiment: {'; '.join(fixed)}. Start a new run for that, "
            f"or leave the settings as they were"
        )


def _asynchronous(run: Path, config: Config, *, without_replay: bool) -> Continuation:
    found = checkpoint.load_newest(run / "checkpoints")
    if found is None:
        raise RunError(f"{run}: nothing to resume from: it has no checkpoint yet; start a new run")
    if found.fingerprint != checkpoint.fingerprint(config):
        raise StorageError(f"{run / 'checkpoints'}: the newest checkpoint is of another network, sensing or condition")
    origin = _origin(run)._replace(updates=float(found.learner_step))
    paths = {} if without_replay else _snapshots_of(run, config)
    replays = {name: _snapshot(path, config) for name, path in paths.items()}
    hashes = _hashes_of(found.arrays) | {name: replay.sha256 for name, replay in replays.items()}
    transitions = sum(replay.transitions for replay in replays.values())
    return _continuation(config, "asynchronous", origin, transitions, hashes, [*replays.values()])


def _serial(run: Path, config: Config) -> Continuation:
    store = ReplayStore(config, np.random.default_rng(0))
    saved = serial_state.read_newest(run, store)
    if saved is None:
        raise RunError(f"{run}: nothing to resume from: no state of it was saved yet; start a new run")
    own = saved.state.values["self"]
    learner = {
        name.removeprefix("learner/self/"): array
        for name, array in saved.state.arrays.items()
        if name.startswith("learner/self/")
    }
    env_steps = float(own["num_turns"] * config.bats_per_actor)
    updates = float(saved.state.values["learner"]["self"]["num_updates"])
    origin = Origin(env_steps, 0.0, updates, float(own["wall_elapsed_s"]))
    replay = verify(saved.replay)
    hashes = _hashes_of(learner) | ({} if replay is None else {"replay": replay.sha256})
    return _continuation(config, "serial", origin, len(store.buffer), hashes, [] if replay is None else [replay])


def _continuation(
    config: Config, mode: Mode, origin: Origin, transitions: int, hashes: dict[str, str], replays: list[SnapshotFacts]
) -> Continuation:
    facts = {
        "mode": mode,
        "updates": int(origin.updates),
        "env_steps": int(origin.env_steps),
        "elapsed_s": round(origin.elapsed_s, 3),
        "transitions": transitions,
        "sha256": hashes,
    }
    lines = [
        f"resumed: update {origin.updates:,.0f}, environment step {origin.env_steps:,.0f}, "
        f"{origin.elapsed_s / 60.0:.1f} minutes flown, {transitions:,} transitions",
        "SHA-256: " + ", ".join(f"{name} {value[:SHORT]}" for name, value in hashes.items()),
    ]
    if not replays:
        lines.append("the replay begins empty")
    lines += [f"an older snapshot is used: {replay.refused}" for replay in replays if replay.refused]
    return Continuation(config, mode, origin, facts, tuple(lines))


def _snapshots_of(run: Path, config: Config) -> dict[str, Path]:
    """Returns where the snapshots of a run's replay servers lie, by their names."""
    return {role.name: snapshot_of(run, role) for role in roles_of(config) if role.kind == "replay"}


def _snapshot(path: Path, config: Config) -> SnapshotFacts:
    """Returns the facts of the snapshot that a replay server will restore."""
    way_on = "--without-replay resumes with an empty replay"
    try:
        replay = verify(path)
    except SnapshotError as error:
        raise StorageError(f"the replay cannot be restored: {error}; {way_on}") from None
    if replay is None:
        raise StorageError(f"{path}: no snapshot of the replay was written yet; {way_on}")
    buffer = ReplayStore(config, np.random.default_rng(0)).buffer
    wanted = {"capacity": buffer.capacity, "num_rows": buffer.num_rows, "memory_steps": buffer.memory_steps}
    if replay.fits != wanted:
        raise StorageError(f"{replay.path}: was made with {replay.fits}, the settings give {wanted}; {way_on}")
    return replay


def _hashes_of(arrays: dict[str, Any]) -> dict[str, str]:
    """Returns the hashes of network, target network, averaged network and optimiser of a learner's arrays."""
    parts = {"network": ONLINE, "target": TARGET, "average": AVERAGE, "optimiser": OPTIMISER}
    return {
        name: digest(part)
        for name, prefix in parts.items()
        if (part := {key: array for key, array in arrays.items() if key.startswith(prefix)})
    }


def _origin(run: Path) -> Origin:
    """Returns what a run had done when its launcher last noted it, at most a second before its end."""
    try:
        progress = read_json(run / STATUS)["progress"]
        return Origin(**{name: float(progress[name]) for name in Origin._fields})
    except (StorageError, KeyError, TypeError, ValueError) as error:
        raise StorageError(f"{run / STATUS}: does not tell how far the run had come: {error!r}") from None


def _check_limits(run: Path, config: Config, origin: Origin) -> None:
    train = config.train
    for name, used, limit in (
        ("max_minutes", origin.elapsed_s / 60.0, train.max_minutes),
        ("max_env_steps", origin.env_steps, train.max_env_steps),
        ("max_updates", origin.updates, train.max_updates),
    ):
        if limit is not None and used >= limit:
            raise RunError(
                f"{run}: is complete: train.{name} is {limit:g}, and {used:,.6g} are done; to go on, "
                f"raise it with --set train.{name}=..."
            )


def _facts_of(run: Path) -> dict[str, Any]:
    if not (run / "run.json").exists():
        raise RunError(f"{run}: no run here (run.json is missing)")
    return read_json(run / "run.json")
