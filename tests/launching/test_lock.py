"""One launcher a run folder, and none while something of the former one lives."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from apex_bat.launching.lock import InUseError, locked

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked there")
HOLD = "import sys; sys.stdout.write('x'); sys.stdout.flush(); sys.stdin.read()"


def test_a_second_launcher_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    with locked(tmp_path) as descriptor:
        assert descriptor is not None
        with pytest.raises(InUseError, match="is still in use"), locked(tmp_path):
            pass
    with locked(tmp_path):
        assert list(tmp_path.iterdir()) == [], "no file is left behind"


def test_a_role_that_outlives_its_launcher_keeps_the_folder(tmp_path: Path) -> None:
    with locked(tmp_path) as descriptor:
        assert descriptor is not None
        role = subprocess.Popen(
            [sys.executable, "-c", HOLD], pass_fds=(descriptor,), stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert role.stdout is not None
        role.stdout.read(1)
    with pytest.raises(InUseError, match="a launcher or a role of it"), locked(tmp_path):
        pass
    role.communicate()
    with locked(tmp_path):
        pass


def test_who_waits_for_the_last_roles_gets_the_folder_when_they_are_gone(tmp_path: Path) -> None:
    with locked(tmp_path) as descriptor:
        assert descriptor is not None
        role = subprocess.Popen([sys.executable, "-c", HOLD], pass_fds=(descriptor,), stdin=subprocess.PIPE)
    assert role.stdin is not None
    role.stdin.close()
    with locked(tmp_path, patience_s=60.0):
        assert role.wait(60) == 0


def test_a_launcher_that_runs_is_not_waited_for(tmp_path: Path) -> None:
    with pytest.raises(InUseError, match="is still running"), locked(tmp_path, lambda: True, 1e9):
        pass
    assert os.listdir(tmp_path) == []
