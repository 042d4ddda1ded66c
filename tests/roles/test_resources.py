"""A process is told from others by what no setting of the clock changes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from apex_bat.roles import resources
from apex_bat.roles.resources import began_unix_s, birth_of, is_same_process

HOLD = "import sys; sys.stdout.write('x'); sys.stdout.flush(); sys.stdin.read()"
linux = pytest.mark.skipif(sys.platform != "linux", reason="only there the time of making comes from the clock")


@linux
@pytest.mark.parametrize("step_s", [-86_400.0, -5.0, 5.0, 86_400.0])
def test_a_clock_that_is_set_makes_no_living_process_another(step_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    birth, began = birth_of(os.getpid()), began_unix_s(os.getpid())
    assert birth is not None
    assert began is not None
    monkeypatch.setattr(psutil.Process, "create_time", lambda _: began + step_s)
    assert not is_same_process(os.getpid(), began), "what psutil reckons from the clock would call it another"
    assert is_same_process(os.getpid(), birth)


def test_a_process_is_not_the_one_that_had_its_number_before() -> None:
    birth = birth_of(os.getpid())
    assert birth is not None
    assert is_same_process(os.getpid(), birth)
    if isinstance(birth, str):
        boot, _, ticks = birth.rpartition(" ")
        assert not is_same_process(os.getpid(), f"{boot} {int(ticks) - 100}")
        assert not is_same_process(os.getpid(), f"another-boot {ticks}")


def test_older_versions_noted_a_time() -> None:
    began = began_unix_s(os.getpid())
    assert began is not None
    assert is_same_process(os.getpid(), began)
    assert not is_same_process(os.getpid(), began - 60.0)


def test_who_has_ended_has_no_birth_not_even_before_it_is_collected() -> None:
    process = subprocess.Popen([sys.executable, "-c", HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdin is not None
    process.stdout.read(1)
    birth = birth_of(process.pid)
    assert birth is not None
    assert is_same_process(process.pid, birth)
    process.stdin.close()
    process.stdout.read()  # to its end: the process is ending
    if os.name == "posix":
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # ended, and not collected
        assert birth_of(process.pid) is None
        assert not is_same_process(process.pid, birth)
    process.stdout.close()
    process.wait()
    assert birth_of(process.pid) is None


@linux
def test_a_name_with_blanks_and_brackets_is_no_obstacle(monkeypatch: pytest.MonkeyPatch) -> None:
    stat = "7 (a) S 1) b) S " + " ".join(str(number) for number in range(4, 53))
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: stat)
    resources._boot.cache_clear()
    try:
        birth = birth_of(7)
    finally:
        resources._boot.cache_clear()
    assert isinstance(birth, str)
    assert birth.endswith(" 22"), "field 22 of proc(5)"
