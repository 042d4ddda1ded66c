"""Whole runs on a Ray cluster of several nodes on this machine: placed, learning, surviving, ending as elsewhere."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.launching.small_run import SMALL, options

pytest.importorskip("ray")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(240),
    pytest.mark.skipif(sys.platform != "linux", reason="Ray has clusters on Linux only"),
]

SETTINGS = {
    **SMALL, "actors": "2", "evaluation.flights": "1", "replay.snapshot_period_s": "2.0", "cluster.role_cpus": "0.5",
    "cluster.learner_resource": "server", "cluster.replay_resource": "server",
}  # fmt: skip
STORE_BYTES = 80 * 2**20


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head, and two nodes that may hold replay and learner."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (
            ("RAY_AUTH_MODE", "disabled"), ("RAY_USAGE_STATS_ENABLED", "0"), ("RAY_worker_niceness", "0"),
        ):  # fmt: skip
            patch.setenv(name, value)
        from ray.cluster_utils import Cluster

        head = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": STORE_BYTES}
        one = Cluster(initialize_head=True, head_node_args=head)
        try:
            for _ in range(2):
                one.add_node(num_cpus=3, object_store_memory=STORE_BYTES, resources={"server": 2})
            one.wait_for_nodes()
            yield one
        finally:
            one.shutdown()  # type: ignore[no-untyped-call]


def start(cluster: Any, run: Path, *words: str, **changes: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "apex_bat", "train", "--cluster", cluster.address, *words]
    command += ["--run", str(run), *options(SETTINGS, **changes)] if "--resume" not in words else []
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def status(run: Path) -> dict[str, dict[str, Any]]:
    path = run / "status.json"
    return {row["role"]: row for row in json.loads(path.read_text())["roles"]} if path.exists() else {}


def step(run: Path) -> float:
    return float(status(run).get("learner", {}).get("metrics", {}).get("learner_step", 0.0))


def role_processes(run: Path) -> list[psutil.Process]:
    """The roles' processes of a run, wherever they came from."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        words = process.info["cmdline"] or []
        if str(run) in words and "--orders" in words:
            found.append(process)
    return found


def eventually(condition: Callable[[], object], within_s: float, what: str) -> None:
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {within_s} s: {what}"
        time.sleep(0.1)


def test_a_place_away_from_a_node_is_on_another_inside_the_group_or_outside(cluster: Any, tmp_path: Path) -> None:
    code = f"""
import ray
from pathlib import Path
from apex_bat.config import load
from apex_bat.launching.cluster.keeper import MARK, versions_here
from apex_bat.launching.cluster.placement import demand_of
from apex_bat.launching.cluster.ray_keepers import RayPlacer
from apex_bat.roles.plan import Role
from ray.util.placement_group import placement_group

ray.init({cluster.address!r}, log_to_driver=False)
config = load(None, ["cluster.role_cpus=0.5", "cluster.learner_resource=server"])
role, other = Role("learner", 0), Role("actor", 7)
demands = {{role.name: demand_of(role, config, has_gpu=False)}}
group = placement_group(list(demands.values()), strategy="PACK")
ray.get(group.ready())
folder = Path({str(tmp_path)!r})
(folder / MARK).write_text("m")
placer = RayPlacer(config, folder, "m", group, demands)

def node_of(role, away_from=""):
    remote = placer.place(role, away_from)
    node = ray.get(remote.call("site", versions_here(), role), timeout=60).node
    remote.dismiss()
    return node

home = node_of(role)
print(home != "", node_of(role, home) not in ("", home), node_of(role, "f" * 56) == home)
print(node_of(other, home) != home)
print(*placer.fates([home, "f" * 56]).values())
"""
    done = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True, timeout=120, check=False)
    lines = done.stdout.strip().splitlines()
    assert lines == ["True True True", "True", "unknown removed"], done.stderr


def test_a_run_ends_with_the_same_folder_and_code_as_on_one_machine_and_can_be_resumed(
    cluster: Any, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    process = start(cluster, run, train__max_updates="100")
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert "of 1" in output
    facts = json.loads((run / "run.json").read_text())
    assert facts["outcome"] == "completed"
    for name in ("config.toml", "status.json", "metrics", "checkpoints", "replay", "recordings", "figures"):
        assert (run / name).exists(), name
    for role in ("replay", "learner", "actor-0", "actor-1", "evaluator"):
        assert (run / "metrics" / f"{role}.jsonl").exists(), role
        assert (run / "logs" / f"{role}.log").exists(), role
    assert json.loads((run / "evaluation" / "final.json").read_text())["flights"]
    assert not list(run.rglob(".same-folder"))
    assert not role_processes(run)

    process = start(
        cluster, run, "--resume", str(run), "--set", "train.max_updates=150", "--set", "evaluation.arenas=[]"
    )
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert max((run / "checkpoints").glob("step-*.npz")).stem == "step-000000150"


def test_too_few_resources_are_named_instead_of_waited_for_in_silence(cluster: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start(cluster, run, cluster__learner_resource="quantum", cluster__wait_s="4.0")
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 1, output
    assert "waits for a place in the cluster, 4 s at most; asked: " in output
    assert "learner: 1 CPU, 1 quantum" in output
    assert "There is: " in output
    assert "apex-bat: no place in the cluster within 4 s (cluster.wait_s)" in output
    assert "Traceback" not in output
    assert json.loads((run / "run.json").read_text())["outcome"] == "failed"


def test_several_servers_share_the_replay_and_a_killed_one_takes_part_again(cluster: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start(cluster, run, replay__shards="2", train__max_minutes="30.0")

    def inserted(server: str) -> float:
        return float(status(run)[server].get("metrics", {}).get("replay.inserted", 0.0))

    def is_shared() -> bool:
        away = status(run)["learner"].get("metrics", {}).get("reader.servers_away", 1.0)
        return away == 0.0 and min(inserted("replay-0"), inserted("replay-1")) > 0.0

    try:
        eventually(lambda: step(run) > 20 or process.poll() is not None, 60.0, "the learner learns")
        eventually(is_shared, 30.0, "both servers hold experience, and the learner draws from both")
        _kill_role(run, "replay-1")
        eventually(is_shared, 30.0, "the killed one takes part again")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=30)
        assert process.returncode == 130, output
        assert len(list((run / "replay").glob("replay-*.snapshot"))) == 2
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def test_training_goes_on_when_a_role_a_keeper_and_a_node_are_killed_and_grows_with_the_cluster(
    cluster: Any, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    process = start(cluster, run, actors="auto", train__max_minutes="30.0", cluster__role_cpus="1.0")
    try:
        eventually(lambda: step(run) > 20 or process.poll() is not None, 60.0, "the learner learns")
        _kill_role(run, "replay")
        _kill_keeper(run, "learner")
        _lose_node(cluster, run)
        number = len(status(run))
        cluster.add_node(num_cpus=5, object_store_memory=STORE_BYTES)  # of which those that lost their place take 3
        eventually(lambda: len(status(run)) > number, 60.0, "actors are added on the new node")
        assert process.poll() is None

        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=30)
        assert process.returncode == 130, output
        assert "interrupted" in output
        assert "Traceback" not in output
        eventually(lambda: not role_processes(run), 10.0, "no role is left")
        newest = max((run / "checkpoints").glob("step-*.npz"))
        assert int(newest.stem.removeprefix("step-")) >= step(run)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def _kill_role(run: Path, role: str) -> None:
    """Kills a role's process: its keeper says so, and it comes back in the same place."""
    before, begun = status(run)[role], step(run)
    os.kill(before["pid"], signal.SIGKILL)
    eventually(lambda: status(run)[role]["pid"] not in (0, None, before["pid"]), 30.0, f"{role} is back")
    eventually(lambda: step(run) > begun + 20, 40.0, "the learner goes on")


def _kill_keeper(run: Path, role: str) -> None:
    """Kills the process over a role's: the role ends by its leash, and comes back after its grace."""
    before, begun = status(run)[role], step(run)
    parent = psutil.Process(before["pid"]).parent()
    assert parent is not None
    assert "keeper" in " ".join(parent.cmdline()).lower(), "the keeper, not a daemon of Ray"
    parent.kill()
    eventually(lambda: status(run)[role]["pid"] not in (0, None, before["pid"]), 60.0, f"{role} is back")
    eventually(lambda: step(run) > begun, 60.0, "the learner goes on")
    assert not psutil.pid_exists(before["pid"])


def _lose_node(cluster: Any, run: Path) -> None:
    """Kills the raylet over the learner: everything on that node ends, and continues on the other one."""
    learner = psutil.Process(status(run)["learner"]["pid"])
    raylets = {node.all_processes["raylet"][0].process.pid: node for node in cluster.list_all_nodes()}
    node = next(raylets[parent.pid] for parent in learner.parents() if parent.pid in raylets)
    begun = step(run)
    cluster.remove_node(node, allow_graceful=False)
    eventually(lambda: status(run)["learner"]["pid"] not in (0, None, learner.pid), 60.0, "the learner is back")
    eventually(lambda: step(run) > begun, 60.0, "it goes on")
