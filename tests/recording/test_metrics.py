"""The rows of a run: appended at once, and a full disk is an error, never a hang."""

import json
import sys
from pathlib import Path

import pytest

from apex_bat.recording.metrics import MetricsWriter
from apex_bat.storage import StorageError
from apex_bat.transport.messages import Report

REPORT = Report("actor-0", 7, "here", "", "flying", {"env_steps": 5.0, "return": 0.25})


def test_each_row_is_in_the_file_as_soon_as_it_is_appended(tmp_path: Path) -> None:
    writer = MetricsWriter(tmp_path)
    for number in (1, 2):
        writer.append(REPORT, elapsed_s=1.5, env_steps=10, learner_step=3)
        rows = [json.loads(line) for line in (tmp_path / "actor-0.jsonl").read_text().splitlines()]
        assert len(rows) == number
    assert rows[0]["return"] == 0.25
    assert rows[0]["env_steps_total"] == 10
    writer.close()


def test_a_row_that_had_to_wait_carries_the_moment_of_its_report(tmp_path: Path) -> None:
    writer = MetricsWriter(tmp_path, clock=lambda: 99.0)
    writer.append(REPORT, elapsed_s=1.5, env_steps=10, learner_step=3, unix_s=95.0)
    writer.append(REPORT, elapsed_s=5.5, env_steps=10, learner_step=3)
    rows = [json.loads(line) for line in (tmp_path / "actor-0.jsonl").read_text().splitlines()]
    assert [row["unix_s"] for row in rows] == [95.0, 99.0]
    writer.close()


def test_the_same_figures_are_tensorboard_events(tmp_path: Path) -> None:
    writer = MetricsWriter(tmp_path)
    writer.append(REPORT, elapsed_s=1.5, env_steps=10, learner_step=3)
    events = next((tmp_path / "tensorboard").iterdir()).read_bytes()
    assert b"actor-0/return" in events
    assert b"actor-0/env_steps" in events
    writer.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("name", ["actor-0.jsonl", "tensorboard"])
def test_a_full_disk_is_an_error_and_never_a_hang_and_rows_go_on_when_there_is_space(name: str, tmp_path: Path) -> None:
    with Path("/dev/full").open("wb", buffering=0) as full:
        writer = MetricsWriter(tmp_path)
        if name == "tensorboard":
            writer.append(REPORT, elapsed_s=1.5, env_steps=10, learner_step=3)
            assert writer._events is not None
            writer._events._py_recordio_writer._writer = full  # type: ignore[union-attr]
        else:
            (tmp_path / name).symlink_to("/dev/full")
        with pytest.raises(StorageError, match="No space left"):
            writer.append(REPORT, elapsed_s=1.5, env_steps=10, learner_step=3)
    if name == "tensorboard":
        writer.append(REPORT, elapsed_s=2.5, env_steps=11, learner_step=3)
        files = sorted((tmp_path / "tensorboard").iterdir())
        assert len(files) == 2, "what follows a torn event would not be read"
        assert b"actor-0/return" in files[1].read_bytes()
    writer.close()


@pytest.mark.skipif(sys.platform == "win32", reason="limits of file sizes are POSIX")
def test_a_row_that_finds_no_room_for_its_end_leaves_nothing(tmp_path: Path) -> None:
    import resource

    writer = MetricsWriter(tmp_path)
    writer.append(REPORT, elapsed_s=1.5, env_steps=10, learner_step=3)
    path = tmp_path / "actor-0.jsonl"
    former = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, former[1]))
    try:
        with pytest.raises(StorageError):
            writer.append(REPORT, elapsed_s=2.5, env_steps=11, learner_step=3)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, former)
    writer.append(REPORT, elapsed_s=3.5, env_steps=12, learner_step=3)
    writer.close()
    assert [json.loads(line)["env_steps_total"] for line in path.read_text().splitlines()] == [10, 12]


@pytest.mark.parametrize("torn", [b'{"unix_s": 1.5, "rol', b"{"])
def test_the_row_after_a_torn_one_is_not_lost_with_it(torn: bytes, tmp_path: Path) -> None:
    whole = b'{"unix_s": 1.0}\n'
    (tmp_path / "actor-0.jsonl").write_bytes(whole + torn)
    writer = MetricsWriter(tmp_path)
    for elapsed_s in (1.5, 2.5):
        writer.append(REPORT, elapsed_s=elapsed_s, env_steps=10, learner_step=3)
    writer.close()
    lines = (tmp_path / "actor-0.jsonl").read_bytes().splitlines()
    assert lines[:2] == [whole.rstrip(), torn]
    assert [json.loads(line)["elapsed_s"] for line in lines[2:]] == [1.5, 2.5]


def test_rows_of_a_file_that_goes_on_follow_without_an_empty_line(tmp_path: Path) -> None:
    for elapsed_s in (1.5, 2.5):
        writer = MetricsWriter(tmp_path)
        writer.append(REPORT, elapsed_s=elapsed_s, env_steps=10, learner_step=3)
        writer.close()
    lines = (tmp_path / "actor-0.jsonl").read_bytes().split(b"\n")
    assert [json.loads(line)["elapsed_s"] for line in lines[:-1]] == [1.5, 2.5]
    assert lines[-1] == b""
