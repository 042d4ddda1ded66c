"""What `status` says: live figures of a live launcher only."""

import json
import os
import socket
from pathlib import Path
from typing import Any

import pytest

from apex_bat.launching.status import figures, read_status
from apex_bat.roles.resources import began_unix_s
from apex_bat.storage import StorageError

WRITTEN_S = 1_000_000.0


def write(folder: Path, **changes: Any) -> Path:
    row = {"role": "learner", "pid": 77, "host": "here", "address": "ipc:///w", "restarts": 2,
           "heartbeat_age_s": 0.5, "state": "learning", "metrics": {"updates_per_s": 12.0}}  # fmt: skip
    content = {
        "launcher_pid": os.getpid(), "launcher_began_unix_s": began_unix_s(os.getpid()), "host": socket.gethostname(),
        "written_unix_s": WRITTEN_S, "ended": False, "stall": "", "roles": [row],
    }  # fmt: skip
    (folder / "status.json").write_text(json.dumps(content | changes))
    return folder


def test_a_live_launchers_rows_are_as_it_wrote_them_with_their_ages_brought_up_to_now(tmp_path: Path) -> None:
    status = read_status(write(tmp_path), now_unix_s=WRITTEN_S + 1.0)
    assert (status["launcher"], status["verdict"]) == ("runs", "")
    assert status["roles"][0]["heartbeat_age_s"] == 1.5
    assert (status["roles"][0]["pid"], status["roles"][0]["state"]) == (77, "learning")


def test_a_launcher_whose_number_another_process_has_got_is_gone(tmp_path: Path) -> None:
    folder = write(tmp_path, launcher_began_unix_s=1.0)
    status = read_status(folder, now_unix_s=WRITTEN_S + 1.0)
    assert status["launcher"] == "gone"
    assert "launcher gone since 1970-01-1" in status["verdict"]
    row = status["roles"][0]
    assert (row["pid"], row["state"], row["last_state"]) == (None, "not running", "learning")


def test_a_launcher_that_lives_and_writes_nothing_is_said_to(tmp_path: Path) -> None:
    status = read_status(write(tmp_path), now_unix_s=WRITTEN_S + 60.0)
    assert status["launcher"] == "quiet"
    assert "60 s ago" in status["verdict"]
    assert "stopped, or its disk is full or slow" in status["verdict"]


def test_of_a_launcher_on_another_host_only_its_silence_tells(tmp_path: Path) -> None:
    folder = write(tmp_path, host="elsewhere", launcher_began_unix_s=1.0)
    assert read_status(folder, now_unix_s=WRITTEN_S + 1.0)["launcher"] == "runs"
    assert "on elsewhere" in read_status(folder, now_unix_s=WRITTEN_S + 60.0)["verdict"]


def test_a_run_that_has_ended_is_not_gone(tmp_path: Path) -> None:
    status = read_status(write(tmp_path, ended=True, launcher_began_unix_s=1.0), now_unix_s=WRITTEN_S + 60.0)
    assert status["launcher"] == "ended"
    assert status["roles"][0]["state"] == "not running"


def test_a_standstill_is_the_verdict(tmp_path: Path) -> None:
    status = read_status(write(tmp_path, stall="no environment step for 70 s"), now_unix_s=WRITTEN_S + 1.0)
    assert status["verdict"] == "no environment step for 70 s"


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"written_unix_s": "x"}', '{"written_unix_s": 1, "roles": 3}'])
def test_a_damaged_status_is_one_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "status.json").write_text(text)
    with pytest.raises(StorageError, match="damaged"):
        read_status(tmp_path)


def test_figures_are_a_dash_where_nothing_is_known() -> None:
    assert set(figures({}).values()) == {"-"}
    known = {"updates_per_s": 12.3, "process.memory_mb": 310.4, "process.open_files": 41.0, "replay.policy_lag": 7.0}
    assert figures({"metrics": known}) == {"rate": "12 updates/s", "lag": "7", "memory": "310 MB", "files": "41"}
