"""Whole runs of real processes under faults: what the status says meanwhile, and that they go on."""

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

from apex_bat.launching.status import figures, read_status
from apex_bat.roles.resources import began_unix_s
from apex_bat.storage import StorageError
from tests.launching.small_run import SMALL, options

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(os.name != "posix", reason="signals are POSIX"),
]

SETTINGS = {**SMALL, "recording.every_episodes": "0", "launch.heartbeat_timeout_s": "600.0"}
PATIENCE_S = 240.0
"""How long anything may take on a machine that others keep busy."""


class Run:
    """A training run, and what its status says."""

    def __init__(self, folder: Path, **changes: str) -> None:
        self.folder = folder
        command = [sys.executable, "-m", "apex_bat", "train", "--plain", "--run", str(folder)]
        command += options(SETTINGS, **changes)
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def status(self) -> dict[str, Any]:
        try:
            return read_status(self.folder)
        except StorageError:
            return {"roles": [], "stall": "", "verdict": ""}

    def roles(self) -> dict[str, dict[str, Any]]:
        return {row["role"]: row for row in self.status()["roles"]}

    def gauge(self, role: str, name: str) -> float:
        return float(self.roles().get(role, {}).get("metrics", {}).get(name, 0.0))

    def pids(self) -> list[int]:
        return [row["pid"] for row in self.roles().values() if row["pid"]]

    def until(self, condition: Callable[[], object], what: str, within_s: float = PATIENCE_S) -> None:
        deadline_s = time.monotonic() + within_s
        while not condition():
            assert self.process.poll() is None or within_s != PATIENCE_S, f"ended early: {self.output()}"
            assert time.monotonic() < deadline_s, f"not within {within_s} s: {what}; {json.dumps(self.status())}"
            time.sleep(0.05)

    def until_it_learns(self) -> None:
        self.until(lambda: self.gauge("learner", "learner_step") > 10, "the learner learns")

    def output(self) -> str:
        return self.process.communicate(timeout=PATIENCE_S)[0]

    def end(self) -> None:
        pids = self.pids()
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        for pid in pids:
            if began_unix_s(pid) is not None and str(self.folder) in psutil.Process(pid).cmdline():
                os.kill(pid, signal.SIGKILL)


Start = Callable[..., Run]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    runs: list[Run] = []

    def make(name: str = "run", **changes: str) -> Run:
        runs.append(Run(tmp_path / name, **changes))
        return runs[-1]

    yield make
    for run in runs:
        run.end()


def test_a_process_in_reserve_takes_the_place_of_a_killed_learner_and_none_outlives_the_run(start: Start) -> None:
    run = start()
    run.until_it_learns()

    def in_reserve() -> list[psutil.Process]:
        children = psutil.Process(run.process.pid).children()
        return [child for child in children if "--reserve" in child.cmdline() and child.pid not in run.pids()]

    run.until(in_reserve, "a process is in reserve")
    (waiting,) = in_reserve()
    victim, step = run.roles()["learner"]["pid"], run.gauge("learner", "learner_step")
    os.kill(victim, signal.SIGKILL)
    run.until(lambda: run.roles()["learner"]["pid"] == waiting.pid, "it has become the learner")
    run.until(lambda: run.gauge("learner", "learner_step") > step + 10, "it goes on")
    run.until(in_reserve, "another one is in reserve")
    (unused,) = in_reserve()
    run.process.send_signal(signal.SIGINT)
    run.output()
    assert not unused.is_running()


def test_who_waits_says_for_whom_and_a_standstill_is_told(start: Start) -> None:
    run = start(launch__stall_s="3.0")
    run.until_it_learns()

    def states(**expected: str) -> bool:
        roles = run.roles()
        return all(text in roles[name.replace("_", "-")]["state"] for name, text in expected.items())

    for role, expected in (
        ("actor-0", {"learner": "the learner waits for actors", "replay": "the learner waits for actors"}),
        ("replay", {"learner": "no answer from the replay server at ipc:", "actor_0": "replay server: no answer"}),
        ("learner", {"replay": "actors wait for the learner", "actor_0": "actors wait for the learner"}),
    ):
        pid = run.roles()[role]["pid"]
        os.kill(pid, signal.SIGSTOP)
        try:
            run.until(lambda expected=expected: states(**expected), f"the others say that they wait for {role}")  # type: ignore[misc]
            run.until(lambda: run.status()["stall"], "the standstill is told")
            verdict = run.status()["verdict"]
            assert "no environment step and no update for" in verdict
            assert all(text in verdict for text in expected.values()), verdict
        finally:
            os.kill(pid, signal.SIGCONT)
        step = run.gauge("learner", "learner_step")
        run.until(lambda step=step: run.gauge("learner", "learner_step") > step + 5, "it goes on")  # type: ignore[misc]
        run.until(lambda: not run.status()["stall"], "and no longer says that it stands")
    assert "no environment step" in (run.folder / "logs" / "launcher.log").read_text()

    for row in run.roles().values():
        texts = figures(row)
        assert row["restarts"] == 0
        assert texts["memory"].endswith(" MB"), row
        assert texts["files"] != "-"
    assert figures(run.roles()["actor-0"])["rate"].endswith("steps/s")
    assert figures(run.roles()["replay"])["lag"] != "-"


@pytest.mark.parametrize("role", ["actor-0", "evaluator"])
def test_a_stopped_role_is_noticed_by_its_heartbeat_killed_and_replaced(role: str, start: Start) -> None:
    run = start(launch__heartbeat_timeout_s="5.0", launch__max_failures="1000")
    run.until_it_learns()
    victim = run.roles()[role]["pid"]
    os.kill(victim, signal.SIGSTOP)
    run.until(lambda: run.roles()[role]["pid"] not in (victim, None), "it is replaced")
    assert began_unix_s(victim) is None, "the stopped one is gone"
    run.until(lambda: run.roles()[role]["metrics"].get("process.memory_mb") and "starting" not in
              run.roles()[role]["state"], "its successor works")  # fmt: skip
    assert f"{role}: silent for" in (run.folder / "logs" / "launcher.log").read_text()


def test_children_of_a_killed_launcher_end_also_a_stopped_one_and_the_status_says_so(start: Start) -> None:
    run = start(launch__grace_s="6.0")
    run.until_it_learns()
    pids = run.pids()
    os.kill(run.roles()["actor-0"]["pid"], signal.SIGSTOP)
    run.process.kill()
    run.process.wait()
    run.until(lambda: not any(began_unix_s(pid) is not None for pid in pids), "all roles are gone", within_s=10.0)
    status = read_status(run.folder)
    assert status["launcher"] == "gone"
    assert status["verdict"].startswith("launcher gone since 2")
    assert {row["state"] for row in status["roles"]} == {"not running"}
    assert {row["pid"] for row in status["roles"]} == {None}


def test_a_role_killed_while_the_run_ends_does_not_spoil_it(start: Start) -> None:
    run = start(launch__grace_s="10.0", train__max_updates="400")
    run.until_it_learns()
    evaluator = run.roles()["evaluator"]["pid"]
    os.kill(evaluator, signal.SIGSTOP)  # so that the run waits for its end, the whole grace
    run.until(lambda: run.roles()["learner"]["pid"] is None, "the learner has ended")
    replay = run.roles()["replay"]["pid"]
    if replay is not None:
        os.kill(replay, signal.SIGKILL)
    output = run.output()
    assert run.process.returncode == 0, output
    assert json.loads((run.folder / "run.json").read_text())["outcome"] == "completed"
    assert began_unix_s(evaluator) is None


def test_two_runs_on_one_machine_do_not_disturb_each_other(start: Start) -> None:
    first, second = start("first", train__max_updates="300"), start("second")
    for run in (first, second):
        run.until(lambda run=run: run.gauge("learner", "learner_step") > 10, "it learns")  # type: ignore[misc]
    assert not set(first.pids()) & set(second.pids())
    os.kill(second.roles()["replay"]["pid"], signal.SIGKILL)
    second.process.kill()
    output = first.output()
    assert first.process.returncode == 0, output
    assert all(row["restarts"] == 0 for row in first.roles().values())


def test_a_role_ended_by_somebody_else_is_started_again(start: Start) -> None:
    run = start()
    run.until_it_learns()
    victims = {role: run.roles()[role]["pid"] for role in ("replay", "learner")}
    for pid in victims.values():
        os.kill(pid, signal.SIGTERM)
    run.until(
        lambda: all(run.roles()[role]["pid"] not in (pid, None) for role, pid in victims.items()), "both are replaced"
    )
    step = run.gauge("learner", "learner_step")
    run.until(lambda: run.gauge("learner", "learner_step") > step + 10, "it goes on")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 48 MB, where we may mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", str(folder)], capture_output=True, check=False  # noqa: S607
    )  # fmt: skip
    if mounted.returncode != 0:
        pytest.skip("no file system can be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)  # noqa: S607


def test_a_full_disk_stops_nothing_and_all_is_written_again_when_there_is_space(small_disk: Path, start: Start) -> None:
    run = start("disk/run", replay__snapshot_period_s="1.0", recording__every_episodes="1", train__max_minutes="30.0")
    run.until_it_learns()
    pids = run.pids()
    filler = small_disk / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while file.write(bytes(1 << 16)):
                pass
        except OSError:
            pass
    log = run.folder / "logs" / "launcher.log"
    learner_log = run.folder / "logs" / "learner.log"
    time.sleep(8.0)  # the time in which every writer meets the full disk; nothing can be read that says so
    assert run.process.poll() is None
    assert all(began_unix_s(pid) is not None for pid in pids), "nobody ended"
    filler.unlink()
    freed_unix_s = time.time()
    run.until(lambda: json.loads((run.folder / "status.json").read_text())["written_unix_s"] > freed_unix_s, "status")
    assert sorted(run.pids()) == sorted(pids), "and nobody was started anew"
    run.until(lambda: run.gauge("replay", "replay.failed_snapshots") > 0, "snapshots had failed")
    for name in ("checkpoints/step-*.npz", "replay/replay.snapshot", "recordings/*.rrd", "metrics/*.jsonl"):
        run.until(
            lambda name=name: any(p.stat().st_mtime > freed_unix_s for p in run.folder.glob(name)),  # type: ignore[misc]
            f"{name} is written again",
        )
    for path in (run.folder / "metrics").glob("*.jsonl"):
        assert all(json.loads(line) for line in path.read_text().splitlines()), "no row is torn"
    run.process.send_signal(signal.SIGTERM)
    output = run.output()
    assert run.process.returncode == 130, output
    said = output + log.read_text() + learner_log.read_text()
    assert "Traceback" not in said
    assert "training goes on" in said
