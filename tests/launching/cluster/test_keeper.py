"""What keeps a role on another host: its folder, its process, its lease."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import apex_bat
from apex_bat.launching.cluster import keeper as module
from apex_bat.launching.cluster.keeper import MARK, NUM_PORTS, Keeper, first_port, free_port, versions_here
from apex_bat.launching.processes import Recipe
from apex_bat.launching.reserve import Reserve
from apex_bat.launching.supervisor import Exit
from apex_bat.roles.plan import Role

ACTOR = Role("actor", 2)


class Process:
    """Stands for a role's process; keeps what it is told."""

    made: list[Process]

    def __init__(self, recipe: Recipe, incarnation: int, flown_steps: int, **more: Any) -> None:
        self.given = (recipe.role, recipe.run, incarnation, recipe.num_threads, flown_steps)
        self.told, self.folder, self.cleans = [more["orders"]], recipe.folder, more["cleans"]
        self.reserve: Reserve | None = more["reserve"]
        self.ended: Exit | None = None
        self.is_killed = threading.Event()
        self.pid = 100 + len(self.made)
        self.made.append(self)

    def poll(self) -> Exit | None:
        return self.ended

    def tell(self, orders: bytes) -> None:
        self.told.append(orders)

    def tend_reserve(self) -> None:
        if self.reserve is not None:
            self.reserve.tend()

    def stop(self) -> None:
        self.ended = Exit(0, "")
        if self.reserve is not None:
            self.reserve.let_go()

    def kill(self) -> None:
        self.ended = self.ended or Exit(-9, "")
        self.is_killed.set()


class Clock:
    """Shows what the test says."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


Make = Callable[..., Keeper]


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def make(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    monkeypatch.setattr(module, "RoleProcess", Process)
    monkeypatch.setattr(module, "PATIENCE_S", 0.0)
    Process.made = []
    made: list[Keeper] = []

    def one(mark: str = "m", folder: str = "/nowhere") -> Keeper:
        made.append(Keeper(str(tmp_path), mark, folder, 10.0, "127.0.0.1", clock=clock))
        return made[-1]

    (tmp_path / MARK).write_text("m")
    yield one
    for each in made:
        each.close()


def start(keeper: Keeper, life: int = 1) -> int:
    return keeper.start(life, ACTOR, 7, 1, 500, b"first\n")


def test_a_role_is_started_told_and_looked_at(make: Make, tmp_path: Path) -> None:
    keeper = make(folder=str(tmp_path))
    assert start(keeper) == 100
    (process,) = Process.made
    assert process.given == (ACTOR, tmp_path, 7, 1, 500)
    assert process.folder == tmp_path
    assert not process.cleans, "a keeper that is late would remove what the next life writes"
    look = keeper.look(0, b"news\n")
    assert process.told == [b"first\n", b"news\n"]
    assert (look.life, look.pid, look.has_ended) == (1, 100, False)
    process.ended = Exit(3, "it broke")
    look = keeper.look(look.number)
    assert (look.has_ended, look.code, look.detail) == (True, 3, "it broke")


def test_a_role_has_a_reserve_where_one_is_asked_for_until_it_is_to_end(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    monkeypatch.setattr(Recipe, "start", lambda *_: subprocess.Popen(waits, stdin=subprocess.PIPE))
    keeper = make()
    keeper.start(1, ACTOR, 7, 1, 500, b"first\n", True)
    keeper.start(2, ACTOR, 8, 1, 500, b"first\n", True)
    first, second = (process.reserve for process in Process.made)
    assert first is not None
    assert first is second
    keeper.look(0)
    waiting = first._process
    assert waiting is not None
    keeper.kill()
    assert waiting.poll() is None, "it is for the next life"
    keeper.stop()
    assert waiting.wait(10.0) == 0
    start(make())
    assert Process.made[-1].reserve is None


def test_what_was_prepared_before_the_role_may_begin_is_its_reserve(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = [sys.executable, "-c", "import sys; sys.stdin.read()"]
    started: list[Recipe] = []

    def begin(recipe: Recipe, *words: str) -> subprocess.Popen[bytes]:
        assert words == ("--reserve",)
        started.append(recipe)
        return subprocess.Popen(waits, stdin=subprocess.PIPE)

    monkeypatch.setattr(Recipe, "start", begin)
    keeper = make()
    for _ in range(2):
        keeper.prepare(ACTOR, 3)
    (recipe,) = started
    assert (recipe.role, recipe.num_threads, recipe.is_ordered) == (ACTOR, 3, True)
    assert not Process.made, "the role has not begun"
    keeper.start(1, ACTOR, 7, 3, 500, b"first\n", True)
    reserve = Process.made[0].reserve
    assert reserve is not None
    waiting = reserve._process
    assert waiting is not None
    keeper.close()
    assert waiting.wait(10.0) == 0


def test_a_second_start_ends_the_first_process(make: Make) -> None:
    keeper = make()
    start(keeper)
    assert start(keeper, life=2) == 101
    assert Process.made[0].is_killed.is_set()
    assert keeper.look(0).life == 2


def test_the_role_is_killed_when_the_lease_lapses_and_nothing_is_started_then(make: Make, clock: Clock) -> None:
    keeper = make()
    start(keeper)
    clock.now_s = 9.0
    assert not Process.made[0].is_killed.wait(3 * module.LOOK_S)
    clock.now_s = 10.0
    assert Process.made[0].is_killed.wait(10.0)
    assert start(keeper, life=2) == 0, "an order that was long under way"
    assert len(Process.made) == 1
    look = keeper.look(0)
    assert (look.code, look.detail) == (-9, "its host had not heard the launcher for the lease")
    keeper.look(look.number)
    assert start(keeper, life=3) == 101, "the launcher is heard again"


def test_looks_keep_the_role_alive(make: Make, clock: Clock) -> None:
    keeper = make()
    start(keeper)
    seen = 0
    for _ in range(20):
        clock.now_s += 4.0
        seen = keeper.look(seen).number
    assert not Process.made[0].is_killed.wait(3 * module.LOOK_S)


def test_a_folder_that_is_not_the_launchers_is_refused(make: Make, tmp_path: Path) -> None:
    assert make().site(versions_here(), ACTOR).problem == ""
    assert "another folder" in make(mark="other").site(versions_here(), ACTOR).problem
    (tmp_path / MARK).unlink()
    problem = make().site(versions_here(), ACTOR).problem
    assert "No such file" in problem
    assert "give --run a folder that all nodes share" in problem


def test_other_versions_are_refused(make: Make) -> None:
    assert "versions differ" in make().site(("0.0.0", "3.11"), ACTOR).problem


def test_a_port_is_one_of_those_allowed_and_free() -> None:
    port = free_port("127.0.0.1")
    assert port > 0
    assert free_port("127.0.0.1", port) in range(port, port + 100)


def test_servers_that_look_for_a_port_on_one_host_at_the_same_time_find_different_ones(make: Make) -> None:
    servers = [Role("learner", 0), *(Role("replay", number, 4) for number in range(4))]
    firsts = {first_port(role) for role in servers}
    assert len(firsts - {0}) == len(servers), "0 is the launcher's"
    base_port = free_port("127.0.0.1", 20_000)
    found = [free_port("127.0.0.1", base_port, first_port(role)) for role in servers]
    assert len(set(found)) == len(servers), "although none of them is bound yet"
    assert all(port in range(base_port, base_port + NUM_PORTS) for port in found)
    keeper = make()
    assert keeper.site(versions_here(), servers[0]).port > 0
    assert keeper.site(versions_here(), ACTOR).port == 0, "an actor listens nowhere"


def test_after_the_last_port_comes_the_first() -> None:
    with socket.socket() as one:
        base_port = free_port("127.0.0.1", 20_000)
        found = free_port("127.0.0.1", base_port, NUM_PORTS - 1)
        one.bind(("127.0.0.1", found))
        again = free_port("127.0.0.1", base_port, found - base_port)
        assert again != found
        assert again in range(base_port, base_port + NUM_PORTS)


def test_the_watch_over_the_lease_survives_an_error(make: Make, clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    keeper = make()
    start(keeper)
    (process,), failed = Process.made, threading.Event()

    def broken() -> None:
        failed.set()
        raise RuntimeError("of any kind")

    process.poll = broken  # type: ignore[method-assign]
    clock.now_s = 10.0
    assert failed.wait(10.0)
    del process.poll
    assert process.is_killed.wait(10.0)
    assert "of any kind" in caplog.text


def test_a_role_finds_this_package_wherever_it_came_from(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/other")
    monkeypatch.setattr(apex_bat, "__file__", str(tmp_path / "apex_bat" / "__init__.py"))
    monkeypatch.syspath_prepend(tmp_path)
    start(make())
    assert os.environ["PYTHONPATH"] == f"{tmp_path}{os.pathsep}/other"


def test_closing_ends_the_role(make: Make) -> None:
    keeper = make()
    start(keeper)
    begun_s = time.monotonic()
    keeper.close()
    assert Process.made[0].is_killed.is_set()
    assert time.monotonic() - begun_s < 5.0
