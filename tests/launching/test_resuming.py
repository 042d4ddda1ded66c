"""Resuming: what may change, what is said, and every way in which a folder cannot be gone on with."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest

from apex_bat.config import Config, ConfigError, load
from apex_bat.evaluation import runs
from apex_bat.evaluation.runs import RunError
from apex_bat.experience import NO_ACTION, Chunk
from apex_bat.launching import resuming
from apex_bat.launching.resuming import check_changes, prepare
from apex_bat.replay.snapshot import SnapshotWriter, previous_of
from apex_bat.replay.store import ReplayStore
from apex_bat.replay.verification import verify
from apex_bat.roles import checkpoint
from apex_bat.roles.checkpoint import Checkpoint
from apex_bat.roles.learner import new_agent
from apex_bat.roles.plan import Addresses, Assignment, Role, incarnation_of
from apex_bat.storage import StorageError, digest

SMALL = ("network.channels=[4]", "network.strides=[3]", "network.hidden=[8]", "replay.capacity=500",
         "replay.min_size=50", "train.max_updates=1000")  # fmt: skip


def ended_run(folder: Path, *changes: str) -> Path:
    """A run that flew 640 steps in 30 s and learned 40 updates, as its processes leave it behind."""
    config = load(None, [*SMALL, *changes])
    runs.create(folder, config)
    assignment = Assignment(Role("learner", 0), config, folder, Addresses("", "", ""), threading.Event(), 0)
    arrays = new_agent(assignment).arrays()
    for step in (20, 40):
        counters = {"weights_version": step, "torch_random": ""}
        state = Checkpoint(step, checkpoint.fingerprint(config), counters, arrays | {"online/x": np.array([step])})
        checkpoint.save(folder / "checkpoints", state, keep=5)
    store = ReplayStore(config, np.random.default_rng(0))
    store.add("actor-0", 0, [chunk()])
    for _ in range(2):
        SnapshotWriter(store.buffer, folder / "replay" / "replay.snapshot").advance(store.state, wait=True)
    progress = {"env_steps": 640.0, "episodes": 7.0, "updates": 44.0, "elapsed_s": 30.0}
    (folder / "status.json").write_text(json.dumps({"progress": progress}))
    runs.finish(folder, "interrupted")
    return folder


def chunk() -> Chunk:
    actions = np.zeros(14, np.uint8)
    actions[-1] = NO_ACTION
    return Chunk(
        0, np.ones((14, 2, 24), np.float32), actions, np.arange(11, dtype=np.uint16), np.full(11, 3, np.uint8),
        np.ones(11, np.float32), np.full(11, 0.9, np.float32), np.ones(11, np.float32),
    )  # fmt: skip


def found(run: Path, *overrides: str, serial: bool = False, without_replay: bool = False) -> resuming.Continuation:
    return prepare(run, None, overrides, serial=serial, without_replay=without_replay)


def test_what_is_restored_is_said_and_noted(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    continuation = found(run)
    newest = checkpoint.load_newest(run / "checkpoints")
    replay = verify(run / "replay" / "replay.snapshot")
    assert newest is not None
    assert replay is not None
    network = digest({name: array for name, array in newest.arrays.items() if name.startswith("online/")})
    assert continuation.origin == (640.0, 7.0, 40.0, 30.0), "updates are the checkpoint's"
    assert continuation.facts["sha256"]["network"] == network
    assert continuation.facts["sha256"]["replay"] == replay.sha256
    assert continuation.lines[0] == "resumed: update 40, environment step 640, 0.5 minutes flown, 11 transitions"
    assert f"network {network[:12]}" in continuation.lines[1]
    resuming.apply(run, continuation, without_replay=False)
    facts = json.loads((run / "run.json").read_text())
    assert facts["outcome"] == "running"
    assert [(entry["updates"], entry["transitions"]) for entry in facts["resumed"]] == [(40, 11)]
    assert resuming.num_resumed(run) == 1


def test_former_settings_are_kept_when_they_change(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    former = (run / "config.toml").read_text()
    resuming.apply(run, found(run), without_replay=False)
    assert not list(run.glob("config.toml.*"))
    resuming.apply(run, found(run, "train.max_updates=2000"), without_replay=False)
    assert (run / "config.toml.2").read_text() == former
    assert load(run / "config.toml").train.max_updates == 2000


@pytest.mark.parametrize(
    "change",
    [
        "seed=1", "condition=onset", "arena=circle", "bats_per_actor=8", "network.hidden=[16]", "sonar.rendering=exact",
        "sensing.memory_steps=2", "learner.num_step=2", "learner.discount=0.9", "learner.optimiser=adam",
        "replay.capacity=600", "replay.samples_per_insert=4.0", "exploration.kind=anneal", "episode.max_damage=5",
        "actor.chunk_transitions=20", "body.speed_m_s=2.0", "rays.num_azimuth=50",
    ],
)  # fmt: skip
def test_settings_of_the_experiment_cannot_change(change: str) -> None:
    old = load(None, list(SMALL))
    name = change.partition("=")[0]
    with pytest.raises(ConfigError, match=f"keeps its experiment: {name} was .* and would be "):
        check_changes(old, load(None, [*SMALL, change]), "asynchronous")


@pytest.mark.parametrize(
    "change",
    [
        "train.max_minutes=99", "launch.grace_s=3", "recording.max_mb=9", "evaluation.flights=3", "checkpoint.keep=9",
        "transport.base_port=9000", "actors=5", "learner.learning_rate=0.0001", "replay.snapshot_period_s=9",
    ],
)  # fmt: skip
def test_settings_of_the_running_can_change(change: str) -> None:
    old, new = load(None, list(SMALL)), load(None, [*SMALL, change])
    check_changes(old, new, "asynchronous")
    if change.startswith("actors"):
        with pytest.raises(ConfigError, match="actors was 2 and would be 5"):
            check_changes(old, new, "serial")
    else:
        check_changes(old, new, "serial")


def test_a_file_of_settings_counts_whole(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    file = tmp_path / "other.toml"
    file.write_text("[train]\nmax_updates = 2000\n")
    with pytest.raises(ConfigError, match=r"network\.channels was"):
        prepare(run, file, (), serial=False, without_replay=False)


def test_mode_must_fit(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    with pytest.raises(ConfigError, match="was begun without --serial"):
        found(run, serial=True)
    runs.note(run, mode="serial")
    with pytest.raises(ConfigError, match="continues whole or not at all"):
        found(run, without_replay=True)
    with pytest.raises(RunError, match="no state of it was saved yet"):
        found(run)


def test_no_run_and_damaged_facts_are_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no run here"):
        found(tmp_path)
    run = ended_run(tmp_path / "run")
    (run / "run.json").write_text("{")
    with pytest.raises(StorageError, match=r"run\.json: torn or corrupted"):
        found(run)


def test_limits_that_are_reached_must_be_raised(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    with pytest.raises(RunError, match=r"is complete: train\.max_updates is 40, and 40 are done; to go on, raise it"):
        found(run, "train.max_updates=40")
    with pytest.raises(RunError, match=r"train\.max_env_steps is 640"):
        found(run, "train.max_env_steps=640")
    with pytest.raises(RunError, match=r"train\.max_minutes is 0.5"):
        found(run, "train.max_minutes=0.5")
    found(run, "train.max_updates=41", "train.max_env_steps=641", "train.max_minutes=0.51")


def test_a_torn_newest_checkpoint_gives_way_and_torn_ones_only_are_refused(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    newest = run / "checkpoints" / "step-000000040.npz"
    newest.write_bytes(newest.read_bytes()[:-200])
    assert found(run).origin.updates == 20.0
    (run / "checkpoints" / "step-000000020.npz").write_bytes(b"")
    with pytest.raises(StorageError, match=r"none of the 2 checkpoints can be read; the newest: .*40\.npz"):
        found(run)
    for path in checkpoint.find(run / "checkpoints"):
        path.unlink()
    with pytest.raises(RunError, match="nothing to resume from"):
        found(run)


def test_a_checkpoint_of_another_network_is_refused(tmp_path: Path) -> None:
    run, other = ended_run(tmp_path / "run"), ended_run(tmp_path / "other", "network.hidden=[9]")
    (other / "checkpoints" / "step-000000040.npz").replace(run / "checkpoints" / "step-000000050.npz")
    with pytest.raises(StorageError, match="of another network"):
        found(run)


def test_a_torn_snapshot_gives_way_to_the_one_before_and_says_so(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    snapshot = run / "replay" / "replay.snapshot"
    snapshot.write_bytes(snapshot.read_bytes()[:100])
    assert "an older snapshot is used" in found(run).lines[-1]
    previous_of(snapshot).write_bytes(b"")
    with pytest.raises(StorageError, match=r"the replay cannot be restored: .*--without-replay resumes with an empty"):
        found(run)
    continuation = found(run, without_replay=True)
    assert continuation.lines[-1] == "the replay begins empty"
    assert continuation.facts["transitions"] == 0
    resuming.apply(run, continuation, without_replay=True)
    assert not snapshot.exists()
    assert not previous_of(snapshot).exists()
    assert (run / "replay" / "replay.snapshot.set-aside").exists()
    with pytest.raises(StorageError, match="no snapshot of the replay was written yet"):
        found(run)


def test_a_snapshot_of_other_settings_is_refused(tmp_path: Path) -> None:
    run, other = ended_run(tmp_path / "run"), ended_run(tmp_path / "other", "replay.capacity=700")
    (other / "replay" / "replay.snapshot").replace(run / "replay" / "replay.snapshot")
    with pytest.raises(StorageError, match=r"was made with .*700"):
        found(run)


def test_a_run_whose_progress_is_unknown_is_refused(tmp_path: Path) -> None:
    run = ended_run(tmp_path / "run")
    (run / "status.json").unlink()
    with pytest.raises(StorageError, match="does not tell how far the run had come"):
        found(run)


def test_no_life_of_a_role_has_the_number_of_another() -> None:
    numbers = [incarnation_of(part, restarts) for part in range(5) for restarts in range(3)]
    assert len(set(numbers)) == len(numbers)
    assert incarnation_of(0, 2) == 2


def test_every_setting_that_may_change_exists() -> None:
    settings = msgspec.to_builtins(Config())
    for pattern in resuming.MAY_CHANGE:
        section, _, name = pattern.partition(".")
        assert section in settings, pattern
        assert name in ("", "*") or name in settings[section], pattern
