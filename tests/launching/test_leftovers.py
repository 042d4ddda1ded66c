"""Unfinished files of dead processes go; what others write, and what a run still needs, stays."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from apex_bat.launching.leftovers import remove_leftovers
from apex_bat.launching.processes import remove_unfinished
from apex_bat.roles.plan import Role


def dead_pid() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def files(run: Path, *names: str) -> list[Path]:
    paths = [run / name for name in names]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    return paths


def test_files_and_folders_of_dead_processes_go(tmp_path: Path) -> None:
    dead, own = dead_pid(), os.getpid()
    left = files(
        tmp_path, f".status.json.{dead}.part", f"checkpoints/.step-000000001.npz.{dead}.part",
        f"metrics/tensorboard/.x.{dead}.part", f"serial/.turn-000000000007.2.{dead}.part/state.npz",
        f".run.json.{own}.part", "serial/.turn-000000000009.part/state.npz",
    )  # fmt: skip  # numbers come again, in containers at once; and older versions gave folders none
    kept = files(
        tmp_path, "status.json", "checkpoints/step-000000001.npz", f"evaluation/.final.json.{os.getppid()}.part",
        f"recordings/evaluation-1.{dead}.rrd.part", "serial/turn-000000000007/state.npz",
    )  # fmt: skip
    removed = remove_leftovers(tmp_path)
    assert len(removed) == len(left)
    assert not [path for path in left if path.exists()]
    assert not list((tmp_path / "serial").glob(".*"))
    assert all(path.exists() for path in kept)
    assert remove_leftovers(tmp_path) == []


def test_a_snapshot_that_was_being_written_goes_unless_it_only_lacks_its_name(tmp_path: Path) -> None:
    newest, previous, writing = files(
        tmp_path, "replay/replay.snapshot", "replay/replay.snapshot.previous", "replay/replay.snapshot.writing"
    )
    newest.unlink()
    remove_unfinished(tmp_path, Role("replay", 0), dead_pid())
    assert remove_leftovers(tmp_path) == []
    assert writing.exists()
    newest.write_bytes(b"whole")
    assert remove_leftovers(tmp_path) == [writing]
    assert previous.exists()
    newest.unlink()
    previous.unlink()
    writing.write_bytes(b"the first of all")
    assert remove_leftovers(tmp_path) == [writing]
