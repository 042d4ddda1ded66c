"""Whatever a recording holds, `inspect` reads it, repairs it or refuses it in a line; it never breaks off or hangs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from apex_bat.recording import probing, reading
from apex_bat.recording.catalog import list_flights
from apex_bat.recording.probing import undecodable
from apex_bat.recording.reading import RecordingError, is_whole, read_flight
from apex_bat.recording.viewing import whole_copies
from tests.fuzz.fuzz_recordings import damaged, small_recording

DEADLY = sorted((Path(__file__).parent / "corpus" / "recordings").iterdir())
"""Recordings of four numbers with one bit flipped, each of which ends rerun's decoder (0.41) with SIGABRT."""
NUM_QUICK = 5
TIMEOUT_S = 100.0


def outcomes(first: int, number: int, timeout_s: float = TIMEOUT_S) -> list[str]:
    """What a process of its own says became of recordings with the damage of some seeds."""
    command = [sys.executable, "-m", "tests.fuzz.fuzz_recordings", str(first), str(number)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s)
    assert done.returncode == 0, f"after {done.stdout.splitlines()[-1:]}: {done.stderr[-2000:]}"
    return [line.split()[1] for line in done.stdout.splitlines()]


def test_damaged_recordings_are_read_repaired_or_refused() -> None:
    found = outcomes(0, NUM_QUICK)
    assert len(found) == NUM_QUICK
    assert set(found) <= {"read", "repaired", "refused"}
    assert len(set(found)) > 1, "not all the same"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_many_damaged_recordings_are_read_repaired_or_refused() -> None:
    assert len(outcomes(NUM_QUICK, 300, timeout_s=800.0)) == 300


def test_damage_is_the_same_for_equal_seeds() -> None:
    assert damaged(bytes(1000), 3) == damaged(bytes(1000), 3)
    assert damaged(bytes(1000), 3) != bytes(1000)


@pytest.mark.parametrize("path", DEADLY, ids=lambda path: path.stem)
def test_what_ends_the_decoder_is_refused_before_it_is_decoded(path: Path) -> None:
    with pytest.raises(RecordingError, match=f"{path.name}: damaged so that nothing can read it"):
        read_flight(path)
    with pytest.raises(RecordingError, match=path.name):
        whole_copies([path], path.parent)


@pytest.mark.skipif(os.name != "posix", reason="how a process was ended is told by its exit code there")
@pytest.mark.parametrize("path", DEADLY, ids=lambda path: path.stem)
def test_it_would_end_the_process(path: Path) -> None:
    """Else the corpus shows nothing: it is to be made anew for this version of rerun."""
    script = "import sys; from rerun.chunk import RrdReader; RrdReader(sys.argv[1]).stream().to_chunks()"
    assert subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True).returncode < 0


def test_deadly_recordings_are_found_among_others_and_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    small_recording(folder / "whole.rrd")
    (folder / "odd.rrd").write_bytes(b"no recording at all")
    for path in DEADLY:
        shutil.copy(path, folder)
    paths = sorted(folder.iterdir())
    assert undecodable(paths) == [path for path in paths if path.name.startswith("panic")]
    assert undecodable([*paths[:1], folder / "none.rrd"]) == []
    assert [entry.path.name for entry in list_flights(tmp_path)] == ["whole.rrd"]


def test_inspect_of_a_deadly_recording_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "recordings").mkdir()
    shutil.copy(DEADLY[0], tmp_path / "recordings")
    command = [sys.executable, "-m", "apex_bat", "inspect", str(tmp_path), "--list"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 1
    told, refused = done.stderr.strip().splitlines()
    assert DEADLY[0].name in told
    assert refused.startswith(f"apex-bat: {tmp_path}: no flight recordings")


def test_a_reader_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "slow.rrd"
    small_recording(path)
    monkeypatch.setattr(probing, "TIMEOUT_S", 0.0)
    monkeypatch.setattr(reading, "REPAIR_TIMEOUT_S", 0.0)
    with pytest.raises(RecordingError, match=r"slow\.rrd: damaged so that nothing can read it"):
        read_flight(path)
    with pytest.raises(RecordingError, match="cannot be repaired within 0 s"):
        reading.repair_recording(path, tmp_path / "repaired.rrd")
    assert is_whole(path)
