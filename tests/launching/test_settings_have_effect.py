"""Each setting of `launch` is changed, and something measurable changes."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from apex_bat.config import Config
from apex_bat.config.settings import Launch
from apex_bat.launching.processes import has_reserve
from apex_bat.launching.progress import Progress
from apex_bat.launching.rows import RowThinner
from apex_bat.launching.supervisor import Exit, RoleFailedError, Supervisor
from apex_bat.roles.logs import RotatingLog
from apex_bat.roles.plan import Role
from apex_bat.transport.messages import Report

ROLE = Role("actor", 0)
Measure = Callable[[Launch, Path], object]


class Doomed:
    """A role that the test ends."""

    waiting = ""

    def __init__(self) -> None:
        self.pid, self.ended = 1, threading.Event()

    def poll(self) -> Exit | None:
        return Exit(1, "") if self.ended.is_set() else None

    def stop(self) -> None:
        self.ended.set()

    def kill(self) -> None:
        self.ended.set()


def restarted(launch: Launch, _: Path) -> object:
    """When a role that fails after 15 s each time is started again, until it is given up."""
    handles: list[Doomed] = []

    def start(_role: Role, _incarnation: int) -> Doomed:
        handles.append(Doomed())
        return handles[-1]

    supervisor, now_s, starts = Supervisor([ROLE], start, launch), 0.0, [0.0]
    supervisor.start(now_s)
    try:
        for _attempt in range(12):
            for _look in range(15):
                now_s += 1.0
                supervisor.watch(now_s)
            handles[-1].ended.set()
            supervisor.watch(now_s)
            now_s = supervisor.watched["actor-0"].due_s or now_s
            supervisor.watch(now_s)
            starts.append(now_s)
    except RoleFailedError:
        return starts
    return starts


def killed_after(launch: Launch, is_heard: bool) -> float:
    handle = Doomed()
    supervisor = Supervisor([ROLE], lambda *_: handle, launch)
    supervisor.start(0.0)
    if is_heard:
        supervisor.heard("actor-0", 1, 0.0)
    now_s = 0.0
    while not handle.ended.is_set():
        now_s += 0.5
        supervisor.watch(now_s)
    return now_s


def stood_still(launch: Launch, _: Path) -> float:
    progress, now_s = Progress(launch.stall_s, 0.0), 0.0
    while not progress.stall([], now_s):
        now_s += 0.5
    return now_s


def thinned(launch: Launch, _: Path) -> int:
    thinner = RowThinner(launch.dense_rows_s)
    reports = (Report("replay", 1, "here", "", "serving", {}) for _ in range(20_000))
    return sum(thinner.take(report, float(second)) is not None for second, report in enumerate(reports))


def logged(launch: Launch, folder: Path) -> object:
    """Sizes of the logs after 3 MB."""
    log = RotatingLog(folder / "replay.log", launch)
    for _ in range(300):
        log.emit(logging.LogRecord("test", logging.INFO, "", 1, "x" * 10_000, None, None))
    log.close()
    return sorted((path.name, path.stat().st_size) for path in folder.iterdir())


def ended_by_force(launch: Launch, _: Path) -> object:
    """Where a role that does not end when asked is said to hang, and after how long."""
    script = (
        "import threading, time; from apex_bat.roles.process import hold_leash\n"
        f"hold_leash(threading.Event(), {launch.grace_s})\ntime.sleep(1000)"
    )
    ended = subprocess.run([sys.executable, "-c", script], input="", capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    return ended.stderr.splitlines()[0]


def reserved(launch: Launch, _: Path) -> bool:
    return has_reserve(Role("learner", 0), msgspec.structs.replace(Config(), launch=launch))


CASES: dict[str, tuple[Measure, float]] = {
    "backoff_s": (restarted, 3.0),
    "max_failures": (restarted, 2),
    "quick_failure_s": (restarted, 10.0),
    "start_timeout_s": (lambda launch, _: killed_after(launch, is_heard=False), 10.0),
    "heartbeat_timeout_s": (lambda launch, _: killed_after(launch, is_heard=True), 10.0),
    "learner_in_reserve": (reserved, False),
    "stall_s": (stood_still, 10.0),
    "dense_rows_s": (thinned, 100.0),
    "log_max_mb": (logged, 0.5),
    "log_files": (logged, 1),
    "grace_s": (ended_by_force, 1.0),
}
ALSO = {"log_files": {"log_max_mb": 0.5}, "grace_s": {"grace_s": 0.1}}


def test_every_setting_has_a_case() -> None:
    assert set(Launch.__struct_fields__) == CASES.keys()


@pytest.mark.parametrize("name", CASES)
def test_the_setting_changes_something(name: str, tmp_path: Path) -> None:
    measure, value = CASES[name]
    outcomes: list[object] = []
    for changes in ({}, {name: value}):
        folder = tmp_path / str(len(outcomes))
        folder.mkdir()
        outcomes.append(measure(Launch(**(ALSO.get(name, {}) | changes)), folder))  # type: ignore[arg-type]
    assert outcomes[0] != outcomes[1]
