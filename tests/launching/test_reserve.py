"""Processes in reserve, with one in the place of a role that does nothing until its standard input ends."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from apex_bat.launching.reserve import AFTER_S, Reserve

WAITING = [sys.executable, "-c", "import sys; sys.stdin.read()"]


class Starts:
    """Starts processes, or fails to, and shows the time."""

    def __init__(self) -> None:
        self.made: list[subprocess.Popen[bytes]] = []
        self.now_s = 0.0
        self.error: OSError | None = None

    def __call__(self) -> subprocess.Popen[bytes]:
        if self.error is not None:
            raise self.error
        self.made.append(subprocess.Popen(WAITING, stdin=subprocess.PIPE))
        return self.made[-1]


@pytest.fixture
def starts() -> Iterator[Starts]:
    made = Starts()
    yield made
    for process in made.made:
        process.kill()
        process.wait()
        if process.stdin is not None:
            process.stdin.close()


@pytest.fixture
def reserve(starts: Starts) -> Iterator[Reserve]:
    made = Reserve(starts, lambda: starts.now_s)
    yield made
    made.close()


def test_one_process_waits_and_is_handed_over_once(reserve: Reserve, starts: Starts) -> None:
    assert reserve.take() is None
    reserve.tend()
    reserve.tend()
    assert len(starts.made) == 1
    assert reserve.take() is starts.made[0]
    assert reserve.take() is None
    assert starts.made[0].poll() is None


def test_those_that_die_are_replaced_ever_more_slowly_and_never_handed_over(
    reserve: Reserve, starts: Starts, caplog: pytest.LogCaptureFixture
) -> None:
    for wait_s in (AFTER_S, 2.0 * AFTER_S, 4.0 * AFTER_S):
        num_made = len(starts.made)
        reserve.tend()
        assert len(starts.made) == num_made + 1
        starts.made[-1].kill()
        starts.made[-1].wait()
        reserve.tend()
        assert f"another one is tried in {wait_s:g} s" in caplog.text
        starts.now_s += 0.9 * wait_s
        reserve.tend()
        assert len(starts.made) == num_made + 1
        assert reserve.take() is None
        starts.now_s += 0.1 * wait_s
    reserve.tend()
    assert reserve.take() is starts.made[-1]
    reserve.tend()
    assert len(starts.made) == 5, "one that was of use counts for nothing against the next"


@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX")
def test_one_that_was_stopped_is_killed_instead_of_handed_over(reserve: Reserve, starts: Starts) -> None:
    reserve.tend()
    os.kill(starts.made[0].pid, signal.SIGSTOP)
    os.waitpid(starts.made[0].pid, os.WUNTRACED)
    assert reserve.take() is None
    assert starts.made[0].poll() == -signal.SIGKILL


def test_after_the_end_was_asked_for_none_is_started(reserve: Reserve, starts: Starts) -> None:
    reserve.tend()
    reserve.let_go()
    assert starts.made[0].wait(10.0) == 0
    starts.now_s = 1e6
    reserve.tend()
    assert len(starts.made) == 1


def test_a_machine_that_cannot_start_one_is_asked_again_later(
    reserve: Reserve, starts: Starts, caplog: pytest.LogCaptureFixture
) -> None:
    starts.error = OSError(errno.ENOMEM, "Cannot allocate memory")
    reserve.tend()
    assert "the process in reserve: Cannot allocate memory" in caplog.text
    starts.error = None
    reserve.tend()
    assert not starts.made
    starts.now_s = AFTER_S
    reserve.tend()
    assert len(starts.made) == 1


def test_what_is_not_needed_ends_with_its_standard_input(reserve: Reserve, starts: Starts) -> None:
    reserve.tend()
    reserve.close()
    reserve.close()
    assert starts.made[0].poll() == 0


def test_what_does_not_see_that_it_is_not_needed_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apex_bat.launching.reserve.CLOSE_S", 0.2)
    deaf = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdin=subprocess.PIPE)
    reserve = Reserve(lambda: deaf)
    reserve.tend()
    reserve.close()
    assert deaf.poll() not in (None, 0)
