"""Checkpoints: kept, found, judged."""

import os
from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import Config
from apex_bat.roles import checkpoint
from apex_bat.roles.checkpoint import Checkpoint
from apex_bat.storage import StorageError


def made(step: int) -> Checkpoint:
    arrays = {"online/a": np.full(2, step, np.float32), "target/a": np.zeros(2, np.float32)}
    return Checkpoint(step, checkpoint.fingerprint(Config()), {"version": step}, arrays)


def save(folder: Path, step: int, keep: int = 3) -> Path:
    return checkpoint.save(folder, made(step), keep)


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    found = checkpoint.load(save(tmp_path, 7))
    assert (found.learner_step, found.counters) == (7, {"version": 7})
    assert found.fingerprint == checkpoint.fingerprint(Config())
    np.testing.assert_array_equal(found.policy_parameters()["a"], [7, 7])


def test_the_average_is_what_flies_where_there_is_one() -> None:
    arrays = {"online/a": np.zeros(2, np.float32), "average/a": np.ones(2, np.float32)}
    found = Checkpoint(7, {}, {}, arrays).policy_parameters()
    assert list(found) == ["a"]
    np.testing.assert_array_equal(found["a"], [1, 1])


def test_only_the_newest_are_kept_and_the_best_stays(tmp_path: Path) -> None:
    checkpoint.mark_best(tmp_path, made(1), (1.0, 5.0))
    for step in range(2, 8):
        save(tmp_path, step)
    assert [checkpoint.step_of(path) for path in checkpoint.find(tmp_path)] == [5, 6, 7]
    assert checkpoint.load(tmp_path / checkpoint.BEST).learner_step == 1


def test_best_is_replaced_by_what_is_as_good_and_newer_only(tmp_path: Path) -> None:
    assert checkpoint.mark_best(tmp_path, made(1), (0.5, 9.0))
    assert not checkpoint.mark_best(tmp_path, made(2), (0.4, 99.0))
    assert checkpoint.mark_best(tmp_path, made(3), (0.5, 9.0))
    assert checkpoint.load(tmp_path / checkpoint.BEST).learner_step == 3


def test_of_equally_many_completed_flights_the_newer_is_best_unless_it_comes_less_far_by_a_tenth(
    tmp_path: Path,
) -> None:
    checkpoint.mark_best(tmp_path, made(1), (1.0, 160.0))
    assert not checkpoint.mark_best(tmp_path, made(2), (1.0, 140.0)), "it spins"
    assert checkpoint.mark_best(tmp_path, made(3), (1.0, 150.0))
    assert checkpoint.load(tmp_path / checkpoint.BEST).counters["score"] == [1.0, 150.0]


def test_a_torn_newest_checkpoint_gives_way_to_the_one_before(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(tmp_path, 1)
    torn = save(tmp_path, 2)
    torn.write_bytes(torn.read_bytes()[:100])
    found = checkpoint.load_newest(tmp_path)
    assert found is not None
    assert found.learner_step == 1
    assert torn.name in caplog.text


def test_checkpoints_that_are_all_torn_are_never_a_silent_new_start(tmp_path: Path) -> None:
    assert checkpoint.load_newest(tmp_path) is None
    save(tmp_path, 1).write_bytes(b"")
    with pytest.raises(StorageError, match="none of the 1 checkpoints"):
        checkpoint.load_newest(tmp_path)


def test_a_checkpoint_removed_while_it_was_judged_is_the_best_all_the_same(tmp_path: Path) -> None:
    path = save(tmp_path, 9)
    found = checkpoint.load(path)
    path.unlink()
    assert checkpoint.mark_best(tmp_path, found, (1.0, 1.0))
    np.testing.assert_array_equal(checkpoint.load(tmp_path / checkpoint.BEST).policy_parameters()["a"], [9, 9])


def test_a_torn_checkpoint_does_not_outlive_those_that_come_after_it(tmp_path: Path) -> None:
    newest = checkpoint.load(save(tmp_path, 2))
    save(tmp_path, 5).write_bytes(b"torn")
    checkpoint.set_torn_aside(tmp_path, newest)
    save(tmp_path, 3, keep=1)
    assert [checkpoint.step_of(path) for path in checkpoint.find(tmp_path)] == [3]
    assert (tmp_path / "step-000000005.npz.torn").exists()


def test_a_damaged_best_gives_way_to_the_next(tmp_path: Path) -> None:
    (tmp_path / checkpoint.BEST).write_bytes(b"torn")
    assert checkpoint.mark_best(tmp_path, made(1), (0.0, 0.0))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_costs_the_new_best_and_never_the_old_one(tmp_path: Path) -> None:
    checkpoint.mark_best(tmp_path, made(1), (1.0, 5.0))
    (tmp_path / f".{checkpoint.BEST}.{os.getpid()}.part").symlink_to("/dev/full")
    with pytest.raises(StorageError, match="No space left"):
        checkpoint.mark_best(tmp_path, made(2), (1.0, 6.0))
    assert checkpoint.load(tmp_path / checkpoint.BEST).learner_step == 1
    assert checkpoint.mark_best(tmp_path, made(2), (1.0, 6.0)), "and there is space again"
