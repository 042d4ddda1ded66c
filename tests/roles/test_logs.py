"""Logs: bounded, and a full disk costs lines, not the role."""

import logging
import os
from contextlib import suppress
from pathlib import Path

import pytest

from apex_bat.config.settings import Launch
from apex_bat.roles.logs import RotatingLog, launcher_log


def record(text: str) -> logging.LogRecord:
    return logging.LogRecord("test", logging.INFO, __file__, 1, text, None, None)


@pytest.mark.skipif(os.name != "posix", reason="open files are renamed on POSIX only")
@pytest.mark.parametrize("kept", [0, 1, 3])
def test_logs_together_take_at_most_their_number_times_their_size(kept: int, tmp_path: Path) -> None:
    log = RotatingLog(tmp_path / "actor-0.log", Launch(log_max_mb=0.001, log_files=kept))
    for number in range(500):
        log.emit(record(f"line {number}"))
    log.close()
    files = list(tmp_path.iterdir())
    assert len(files) == kept + 1
    assert all(path.stat().st_size <= 1000 for path in files)
    assert (tmp_path / "actor-0.log").read_text().endswith("line 499\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_costs_lines_and_nobody_is_disturbed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "actor-0.log"
    log = RotatingLog(path, Launch())
    log.emit(record("before"))
    real = log.stream
    with suppress(OSError), Path("/dev/full").open("w") as full:
        log.stream = full
        log.emit(record("lost"))
    log.stream = real
    log.emit(record("after"))
    log.close()
    assert path.read_text() == "before\nafter\n"
    assert "Logging error" not in capfd.readouterr().err


def test_what_the_launcher_says_of_its_roles_is_in_a_log_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    with launcher_log(tmp_path, Launch()):
        logging.getLogger("apex_bat.launching").warning("actor-0: killed by signal 9; starts again in 0.2 s")
    logging.getLogger("apex_bat.launching").warning("after the run")
    text = (tmp_path / "logs" / "launcher.log").read_text()
    assert "launcher WARNING actor-0: killed by signal 9" in text
    assert "after the run" not in text
