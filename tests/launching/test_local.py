"""Whole runs of real processes: they learn, end, survive and leave nothing behind."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from apex_bat.config import Config
from apex_bat.evaluation import runs
from apex_bat.launching import local
from apex_bat.launching.course import Course
from apex_bat.launching.supervisor import Supervisor
from apex_bat.replay.metrics import declared_name
from apex_bat.roles.metrics import DECLARED
from tests.launching.small_run import SMALL, options


def start(run: Path, **changes: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "apex_bat", "train", "--run", str(run), *options(SMALL, **changes)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, preexec_fn=_hear_ctrl_c
    )


def _hear_ctrl_c() -> None:
    """Makes SIGINT heard where the tests run in the background, which makes their children ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def rows(run: Path, role: str) -> list[dict[str, Any]]:
    path = run / "metrics" / f"{role}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def status(run: Path) -> dict[str, dict[str, Any]]:
    path = run / "status.json"
    if not path.exists():
        return {}
    return {row["role"]: row for row in json.loads(path.read_text())["roles"]}


def eventually(condition: Callable[[], object], within_s: float, what: str) -> None:
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {within_s} s: {what}"
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z" if sys.platform == "linux" else True


def is_learning(run: Path) -> bool:
    return any(row.get("learner_step", 0) > 20 for row in rows(run, "learner")[-1:])


@pytest.fixture
def endless(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A run without a near end, killed if the test leaves it alive."""
    run = tmp_path / "run"
    process = start(run)
    try:
        eventually(lambda: is_learning(run), 60.0, "the learner learns")
        yield process, run
    finally:
        pids = [row["pid"] for row in status(run).values() if row["pid"]]
        process.kill()
        process.communicate()
        eventually(lambda: not any(is_alive(pid) for pid in pids), 15.0, "all roles are gone")


@pytest.mark.slow
def test_a_whole_run_learns_evaluates_and_records(tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = start(run, train__max_updates="150")
    output, _ = process.communicate(timeout=100)
    assert process.returncode == 0, output
    assert "2 of 2" in output or "of 2" in output
    assert json.loads((run / "run.json").read_text())["outcome"] == "completed"

    replay, learner, actor = rows(run, "replay")[-1], rows(run, "learner")[-1], rows(run, "actor-0")[-1]
    assert learner["learner_step"] >= 140
    assert actor["learner_step"] > 0, "weights arrived at the actor"
    assert abs(learner["learner_step"] - actor["learner_step"]) <= 60, "and they are not old"
    assert replay["replay.updated_priorities"] > 1000, "priorities came back"
    assert 1.5 <= replay["replay.sampled"] / (replay["replay.inserted"] - 200) <= 2.7

    for role in ("actor-0", "learner", "replay", "evaluator"):
        facts = {"unix_s", "elapsed_s", "role", "pid", "env_steps_total", "learner_step_total", "state"}
        reported = {name for row in rows(run, role) for name in row} - facts
        assert {declared_name(name) for name in reported} <= DECLARED[role.partition("-")[0]].keys(), (
            "every figure is declared"
        )

    final = json.loads((run / "evaluation" / "final.json").read_text())
    assert len(final["flights"]) == 2
    assert {flight["arena"] for flight in final["flights"]} == {"simple"}
    assert list((run / "recordings").glob("evaluation-simple-memory-*-seed20200-*.rrd"))
    assert (run / "recordings" / "training.rrd").exists()
    assert len(list((run / "figures").glob("*.png"))) == 1
    assert not (run / "sockets").exists()
    assert list((run / "metrics" / "tensorboard").iterdir())


@pytest.mark.slow
def test_ctrl_c_ends_everything_within_ten_seconds_with_a_last_checkpoint(
    endless: tuple[subprocess.Popen[str], Path],
) -> None:
    process, run = endless
    pids = [row["pid"] for row in status(run).values()]
    before = rows(run, "learner")[-1]["learner_step"]
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=10)
    assert process.returncode == 130, output
    assert not any(is_alive(pid) for pid in pids)
    assert json.loads((run / "run.json").read_text())["outcome"] == "interrupted"
    newest = max((run / "checkpoints").glob("step-*.npz"))
    assert int(newest.stem.removeprefix("step-")) >= before
    assert list((run / "replay").iterdir())
    assert "Traceback" not in output


@pytest.mark.slow
def test_children_of_a_killed_launcher_end_by_themselves(endless: tuple[subprocess.Popen[str], Path]) -> None:
    process, run = endless
    pids = [row["pid"] for row in status(run).values()]
    process.kill()
    process.wait()
    eventually(lambda: not any(is_alive(pid) for pid in pids), 10.0, "all roles are gone")


@pytest.mark.slow
@pytest.mark.parametrize("role", ["actor-0", "replay", "learner", "evaluator"])
def test_a_killed_role_is_replaced_and_training_goes_on(role: str, endless: tuple[subprocess.Popen[str], Path]) -> None:
    process, run = endless
    victim = status(run)[role]["pid"]
    os.kill(victim, signal.SIGKILL)
    eventually(lambda: status(run)[role]["pid"] not in (victim, None), 20.0, "it is replaced")
    eventually(
        lambda: rows(run, "actor-0")[-1]["env_steps_total"] and status(run)[role]["restarts"] == 1,
        20.0,
        "it is counted",
    )
    learner, flown = rows(run, "learner")[-1]["learner_step"], rows(run, "actor-0")[-1]["env_steps_total"]
    eventually(lambda: rows(run, "learner")[-1]["learner_step"] > learner + 20, 30.0, "the learner goes on")
    eventually(lambda: rows(run, "actor-0")[-1]["env_steps_total"] > flown + 20, 30.0, "the actor goes on")
    assert process.poll() is None


def test_a_run_folder_in_use_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    process = start(tmp_path)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "holds a run already" in output
    assert "Traceback" not in output


@pytest.mark.slow
def test_a_port_in_use_is_named_and_nothing_is_left_running(tmp_path: Path) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        process = start(tmp_path / "run", transport__host="127.0.0.1", transport__base_port=str(port))
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "the port is in use" in output
    assert "Traceback" not in output
    assert not any(is_alive(row["pid"]) for row in status(tmp_path / "run").values() if row["pid"])


@pytest.mark.parametrize(("is_pressed", "outcome"), [(False, "completed"), (True, "interrupted")])
def test_ctrl_c_while_the_roles_of_a_complete_run_end_is_heard(
    is_pressed: bool, outcome: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> list[object]:
        if is_pressed:
            raise KeyboardInterrupt
        return []

    class Blind:
        def show(self, *_: object) -> None: ...
        def __enter__(self) -> None: ...
        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(Course, "follow", lambda *_: ("completed", ""))
    monkeypatch.setattr(Supervisor, "stop", stop)
    run = tmp_path / "run"
    runs.create(run, Config())
    assert local.train(Config(), run, Blind()).outcome == outcome  # type: ignore[arg-type]
