"""A role's process: held by its leash whatever it does, ended by others it says so, and its log keeps crashes."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest

from apex_bat.config import load
from apex_bat.config.loading import dumps
from apex_bat.evaluation import runs
from apex_bat.launching.processes import Recipe, RoleProcess, remove_unfinished
from apex_bat.roles.orders import ORPHANED_S, STOP, line_of
from apex_bat.roles.plan import Addresses, Role
from apex_bat.roles.resources import began_unix_s
from apex_bat.transport.messages import Report
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import new_keys

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals and sessions are POSIX")

CHILD = """
import os, signal, sys, threading, time
from apex_bat.roles.process import hold_leash
stop = threading.Event()
hold_leash(stop, 0.5)
print(os.getpid(), flush=True)
{body}
"""
BODIES = {
    "waits politely": "stop.wait()",
    "is busy in Python": "while True: pass",
    "sleeps": "time.sleep(1000)",
    "is blocked in C": "os.read(os.pipe()[0], 1)",
    "swallows every exception": "while True:\n try: stop.wait(); time.sleep(1000)\n except BaseException: pass",
    "is stopped": "os.kill(os.getpid(), signal.SIGSTOP); time.sleep(1000)",
}
LAUNCHER = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], stdin=subprocess.PIPE, start_new_session=True)
time.sleep(1000)
"""


def eventually(condition: Callable[[], object], within_s: float, what: str) -> None:
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {within_s} s: {what}"
        time.sleep(0.02)


@pytest.mark.parametrize("body", BODIES)
def test_a_role_whose_launcher_is_killed_ends_whatever_it_does(body: str) -> None:
    if body == "is stopped" and sys.platform != "linux":
        pytest.skip("only Linux continues a stopped orphan")
    child = CHILD.format(body=BODIES[body])
    launcher = subprocess.Popen([sys.executable, "-c", LAUNCHER, child], stdout=subprocess.PIPE, text=True)
    assert launcher.stdout is not None
    pid = int(launcher.stdout.readline())
    try:
        if body == "is stopped":
            eventually(lambda: _is_stopped(pid), 10.0, "it is stopped")
        launcher.kill()
        launcher.wait()
        eventually(lambda: began_unix_s(pid) is None, 10.0, "the role is gone")
    finally:
        launcher.stdout.close()
        if began_unix_s(pid) is not None:
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize(("last", "longest_s"), [(b"", 10.0), (STOP, None)])
def test_a_role_whose_keeper_died_is_ended_long_before_its_grace_and_one_that_is_asked_to_end_is_not(
    last: bytes, longest_s: float | None
) -> None:
    child = CHILD.format(body=BODIES["sleeps"]).replace(
        "hold_leash(stop, 0.5)",
        "from apex_bat.roles.orders import StandingOrders\nhold_leash(stop, 1000.0, StandingOrders())",
    )
    process = subprocess.Popen([sys.executable, "-c", child], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdout.readline()
        process.stdin.write(last)
        process.stdin.close()
        if longest_s is not None:
            assert process.wait(longest_s) != 0
        else:
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(2.0 * ORPHANED_S)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def _is_stopped(pid: int) -> bool:
    import psutil

    return bool(psutil.Process(pid).status() == psutil.STATUS_STOPPED)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder with all that a replay server needs to start."""
    for name in ("logs", "replay", "checkpoints"):
        (tmp_path / name).mkdir()
    folder = tmp_path / "sockets"
    folder.mkdir(mode=0o700)
    config = load(None, ["replay.min_size=16", "replay.capacity=100", "launch.log_max_mb=0.002", "launch.log_files=2"])
    (tmp_path / "config.toml").write_text(dumps(config))
    addresses = {name: f"ipc://{folder / name}" for name in ("replay", "weights", "reports")}
    (tmp_path / "addresses.json").write_text(json.dumps(addresses))
    return tmp_path


def ended(process: RoleProcess, within_s: float = 30.0) -> int | None:
    eventually(lambda: process.poll() is not None, within_s, "it ends")
    result = process.poll()
    assert result is not None
    return result.code


def serves(run: Path) -> bool:
    return (run / "sockets" / "replay").exists()


def ends_with_a_snapshot(process: RoleProcess, run: Path) -> None:
    eventually(lambda: serves(run), 30.0, "it serves")
    process.stop()
    assert ended(process) == 0
    assert (run / "replay" / "replay.snapshot").exists()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_role_that_somebody_else_ends_saves_and_says_so(run: Path, number: signal.Signals, code: int) -> None:
    process = RoleProcess(Recipe(Role("replay", 0), run, 1), 0)
    try:
        eventually(lambda: serves(run), 30.0, "it serves")
        os.kill(process.pid, number)
        assert ended(process) == code
        assert (run / "replay" / "replay.snapshot").exists()
    finally:
        process.kill()


def test_a_role_that_its_launcher_lets_go_of_ends_with_a_last_snapshot(run: Path) -> None:
    process = RoleProcess(Recipe(Role("replay", 0), run, 1), 0)
    try:
        ends_with_a_snapshot(process, run)
    finally:
        process.kill()


def test_a_process_in_reserve_begins_the_life_that_it_is_told(run: Path) -> None:
    recipe = Recipe(Role("replay", 0), run, 1)
    reserve = recipe.reserve()
    try:
        reserve.tend()
        waiting = reserve._process
        assert waiting is not None
        process = RoleProcess(recipe, 3, reserve=reserve)
        assert process.pid == waiting.pid
        try:
            ends_with_a_snapshot(process, run)
        finally:
            process.kill()
    finally:
        reserve.close()


def test_a_process_in_reserve_that_is_not_needed_leaves_nothing(run: Path) -> None:
    waiting = Recipe(Role("replay", 0), run, 1).start("--reserve")
    assert waiting.stdin is not None
    waiting.stdin.close()
    assert waiting.wait(30.0) == 0
    assert (run / "logs" / "replay.log").read_bytes() == b""
    assert not any((run / "replay").iterdir())


def test_a_line_that_begins_no_life_is_named(run: Path) -> None:
    waiting = Recipe(Role("replay", 0), run, 1).start("--reserve")
    assert waiting.stdin is not None
    with waiting.stdin as pipe:
        pipe.write(b"{}\n")
    assert waiting.wait(30.0) == 1
    assert "a line of 3 bytes begins no life" in (run / "logs" / "replay.log").read_text()


def test_a_role_has_a_process_in_reserve_while_it_works_and_none_once_it_is_to_end(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = Recipe(Role("replay", 0), run, 1)
    reserve = recipe.reserve()
    process = RoleProcess(recipe, 0, reserve=reserve)
    try:
        process.tend_reserve()
        assert reserve._process is None, "the start of a run has other use for the cores"
        monkeypatch.setattr("apex_bat.launching.processes.AFTER_S", 0.0)
        process.tend_reserve()
        assert reserve._process is not None
        process.stop()
        assert reserve._process.wait(30.0) == 0
        process.tend_reserve()
        assert ended(process) == 0
        process.tend_reserve()
        assert reserve._process.poll() == 0
    finally:
        process.kill()
        reserve.close()


def test_a_crash_in_c_code_is_in_the_log_and_a_log_too_long_is_renamed_first(run: Path) -> None:
    log = run / "logs" / "replay.log"
    log.write_text("line of a former process\n" * 200)
    process = RoleProcess(Recipe(Role("replay", 0), run, 1), 0)
    try:
        eventually(lambda: serves(run), 30.0, "it serves")
        os.kill(process.pid, signal.SIGSEGV)
        assert ended(process) == -signal.SIGSEGV
    finally:
        process.kill()
    assert "former process" in log.with_name("replay.log.1").read_text()
    assert "former process" not in log.read_text()
    assert "Segmentation fault" in log.read_text(), "what faulthandler writes follows the log"


def test_settings_that_a_role_cannot_use_are_the_line_that_a_person_reads(run: Path) -> None:
    (run / "config.toml").write_text("nonsense = 1\n")
    process = RoleProcess(Recipe(Role("replay", 0), run, 1), 0)
    assert ended(process) == 2
    result = process.poll()
    assert result is not None
    assert "nonsense: no such setting" in result.detail


def test_a_torn_snapshot_is_the_line_that_a_person_reads_and_no_reason_to_try_again(run: Path) -> None:
    (run / "replay" / "replay.snapshot").write_bytes(b"torn")
    process = RoleProcess(Recipe(Role("replay", 0), run, 1), 0)
    assert ended(process) == 2
    result = process.poll()
    assert result is not None
    assert "not a snapshot of the replay" in result.detail


def test_what_a_killed_process_was_writing_is_removed_and_nothing_else(run: Path) -> None:
    parts = [run / "checkpoints" / f".step-000000001.npz.{pid}.part" for pid in (11, 12)]
    others = [run / "checkpoints" / "step-000000001.npz", run / "replay" / "replay.snapshot.writing"]
    for path in (*parts, *others):
        path.touch()
    remove_unfinished(run, Role("learner", 0), 11)
    assert not parts[0].exists()
    assert all(path.exists() for path in (parts[1], *others))
    remove_unfinished(run, Role("replay", 0), 13)
    assert not others[1].exists()


def test_a_role_takes_addresses_and_keys_from_its_leash_and_leaves_no_key_behind(tmp_path: Path) -> None:
    """The evaluator, which needs the launcher only: its report comes by the keys that went through the pipe."""
    config, keys = load(None, ["actors=1"]), new_keys()
    runs.create(tmp_path / "run", config)
    collector = ReportCollector("tcp://127.0.0.1:0", keys=keys, generation=9)
    orders = line_of(Addresses("", "", collector.address, reports_generation=9), keys.of_client())
    process = RoleProcess(
        Recipe(Role("evaluator", 0), tmp_path / "run", 1, is_ordered=True, folder=tmp_path), 0, orders=orders
    )
    try:
        reports: list[Report] = []

        def has_reported() -> bool:
            reports.extend(collector.poll(0.1))
            return bool(reports)

        eventually(has_reported, 60.0, "it reports")
        assert reports[0].pid == process.pid
        secret = keys.client_secret
        if sys.platform == "linux":
            proc = Path(f"/proc/{process.pid}")
            assert secret not in (proc / "cmdline").read_bytes()
            assert secret not in (proc / "environ").read_bytes()
        process.stop()
        eventually(lambda: process.poll() is not None, 20.0, "it ends with its leash")
        ended = process.poll()
        assert ended is not None
        assert ended.code == 0
        assert not [path for path in tmp_path.rglob("*") if path.is_file() and secret in path.read_bytes()]
    finally:
        process.kill()
        collector.close()


@pytest.mark.parametrize(("is_ordered", "code"), [(True, 1), (False, 2)])
def test_a_port_in_use_is_tried_again_where_the_next_life_is_given_another_one(
    is_ordered: bool, code: int, run: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        addresses = Addresses(address, "", f"ipc://{run / 'sockets' / 'reports'}")
        if not is_ordered:
            (run / "addresses.json").write_bytes(msgspec.json.encode(addresses))
        process = RoleProcess(
            Recipe(Role("replay", 0), run, 1, is_ordered), 0, orders=line_of(addresses) if is_ordered else b""
        )
        try:
            assert ended(process) == code
        finally:
            process.kill()
    result = process.poll()
    assert result is not None
    assert "the port is in use" in result.detail


def test_orders_that_a_dead_process_did_not_read_hinder_nobody_from_ending_it(run: Path) -> None:
    process = RoleProcess(Recipe(Role("replay", 0), run, 1), 0, cleans=False)
    left = run / "replay" / "replay.snapshot.writing"
    try:
        os.kill(process.pid, signal.SIGKILL)
        assert ended(process) == -signal.SIGKILL
        left.touch()
        pipe = process._process.stdin
        assert pipe is not None
        with suppress(BrokenPipeError):  # what is told in the moment of its death stays in the buffer
            pipe.write(b"x")
            pipe.flush()
        process.stop()
        process.kill()
        assert pipe.closed
        assert left.exists(), "whoever made it said that it is not to clean"
    finally:
        process.kill()
