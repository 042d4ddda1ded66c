"""Whole runs whose replay is spread over two servers: they learn, lose one and go on, and are resumed."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from apex_bat.config import Config, load
from apex_bat.launching import local
from apex_bat.launching.processes import remove_unfinished
from apex_bat.roles.plan import Role, read_addresses, roles_of
from apex_bat.storage import write_text
from tests.launching.small_run import SMALL
from tests.launching.test_faults import Run

TWO = {"replay__shards": "2", "actors": "2"}


def test_roles_are_numbered_where_there_are_several_and_only_there() -> None:
    assert [role.name for role in roles_of(Config())][:2] == ["replay", "learner"]
    two = load(None, ["replay.shards=2", "actors=1"])
    assert [role.name for role in roles_of(two)] == ["replay-0", "replay-1", "learner", "actor-0", "evaluator"]


@pytest.mark.parametrize("host", ["ipc", "127.0.0.1"])
def test_each_server_has_an_address_and_a_generation_of_its_own(tmp_path: Path, host: str) -> None:
    config = load(None, ["replay.shards=3", f"transport.host={host}"])
    with local._addresses(config, tmp_path) as drawn:
        write_text(tmp_path / "addresses.json", msgspec.json.encode(drawn).decode())
        found = read_addresses(tmp_path / "addresses.json")
    assert found == drawn
    assert len({*found.replays, found.weights, found.reports}) == 5
    assert len(set(found.replay_generations)) == 3


def test_a_server_that_ended_takes_only_its_own_unfinished_snapshot_along(tmp_path: Path) -> None:
    (tmp_path / "replay").mkdir()
    for number in range(2):
        (tmp_path / "replay" / f"replay-{number}.snapshot.writing").write_text("")
    remove_unfinished(tmp_path, Role("replay", 1, 2), 5)
    assert [path.name for path in (tmp_path / "replay").iterdir()] == ["replay-0.snapshot.writing"]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("lost", ["replay-0", "replay-1"])
def test_training_goes_on_without_one_server_which_comes_back_from_its_snapshot(tmp_path: Path, lost: str) -> None:
    # The lost server stays away for 20 s, and waits: until then batches can only come from the other.
    run = Run(tmp_path / "run", **TWO, launch__backoff_s="20.0", replay__snapshot_period_s="1.0")
    try:
        run.until_it_learns()
        run.until(lambda: run.gauge(lost, "replay.snapshots") >= 2, "snapshots were written")
        os.kill(run.roles()[lost]["pid"], signal.SIGKILL)
        run.until(lambda: run.gauge("learner", "reader.servers_away") == 1, "the learner notices")
        step = run.gauge("learner", "learner_step")
        run.until(lambda: run.gauge("learner", "learner_step") > step + 50, "it learns from the other server")
        assert not run.roles()[lost]["pid"], "while the lost one is away"
        run.until(lambda: run.gauge("learner", "reader.servers_away") == 0, "the server is back")
        drawn = run.gauge(lost, "replay.drawn")
        run.until(lambda: run.gauge(lost, "replay.drawn") > drawn, "and is drawn from")
        assert "continues: replay: " in (run.folder / "logs" / f"{lost}.log").read_text()
        roles = run.roles()
        assert roles[lost]["restarts"] == 1
        assert sum(role["restarts"] for role in roles.values()) == 1, "nobody else was lost"
    finally:
        run.end()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_run_with_two_servers_keeps_its_ratio_and_is_resumed_from_both_snapshots(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first = Run(folder, **TWO, train__max_updates="400", evaluation__arenas="[]")
    try:
        assert "resumed" not in first.output()
        assert first.process.returncode == 0
    finally:
        first.end()
    before = {name: first.roles()[name]["metrics"] for name in ("replay-0", "replay-1")}
    ratio = sum(m["replay.sampled"] for m in before.values()) / sum(m["replay.inserted"] for m in before.values())
    assert 1.0 < ratio < 2.5
    for metrics in before.values():
        assert abs(metrics["replay.balance"]) <= 2.0 * 16 * float(SMALL["actor.chunk_transitions"])

    command = [sys.executable, "-m", "apex_bat", "train", "--plain", "--resume", str(folder)]
    again = subprocess.run(
        [*command, "--set", "train.max_updates=450"], capture_output=True, text=True, timeout=240, check=False
    )
    assert again.returncode == 0, again.stdout + again.stderr
    assert "replay-0" in again.stdout
    assert "replay-1" in again.stdout
    resumed = json.loads((folder / "run.json").read_text())["resumed"][0]
    assert resumed["transitions"] == sum(metrics["replay.size"] for metrics in before.values())
    assert {"replay-0", "replay-1"} <= resumed["sha256"].keys()
