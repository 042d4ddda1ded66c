"""Checkpoints: kept, found, judged."""

from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import Config
from apex_bat.roles import checkpoint
from apex_bat.roles.checkpoint import Checkpoint
from apex_bat.storage import StorageError


def save(folder: Path, step: int, keep: int = 3) -> Path:
    arrays = {"online/a": np.full(2, step, np.float32), "target/a": np.zeros(2, np.float32)}
    return checkpoint.save(folder, Checkpoint(step, checkpoint.fingerprint(Config()), {"version": step}, arrays), keep)


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    found = checkpoint.load(save(tmp_path, 7))
    assert (found.learner_step, found.counters) == (7, {"version": 7})
    assert found.fingerprint == checkpoint.fingerprint(Config())
    np.testing.assert_array_equal(found.policy_parameters()["a"], [7, 7])


def test_only_the_newest_are_kept_and_the_best_stays(tmp_path: Path) -> None:
    checkpoint.mark_best(tmp_path, save(tmp_path, 1), (1.0, 5.0))
    for step in range(2, 8):
        save(tmp_path, step)
    assert [checkpoint.step_of(path) for path in checkpoint.find(tmp_path)] == [5, 6, 7]
    assert checkpoint.load(tmp_path / checkpoint.BEST).learner_step == 1


def test_best_is_replaced_by_what_is_as_good_and_newer_only(tmp_path: Path) -> None:
    assert checkpoint.mark_best(tmp_path, save(tmp_path, 1), (0.5, 9.0))
    assert not checkpoint.mark_best(tmp_path, save(tmp_path, 2), (0.4, 99.0))
    assert checkpoint.mark_best(tmp_path, save(tmp_path, 3), (0.5, 9.0))
    assert checkpoint.load(tmp_path / checkpoint.BEST).learner_step == 3


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


def test_a_checkpoint_removed_while_it_was_judged_is_not_the_best(tmp_path: Path) -> None:
    assert not checkpoint.mark_best(tmp_path, tmp_path / "step-000000009.npz", (1.0, 1.0))
    assert not (tmp_path / checkpoint.BEST).exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_costs_the_new_best_and_never_the_old_one(tmp_path: Path) -> None:
    checkpoint.mark_best(tmp_path, save(tmp_path, 1), (1.0, 5.0))
    (tmp_path / ".best.part").symlink_to("/dev/full")
    with pytest.raises(StorageError, match="No space left"):
        checkpoint.mark_best(tmp_path, save(tmp_path, 2), (1.0, 6.0))
    assert checkpoint.load(tmp_path / checkpoint.BEST).learner_step == 1
    assert checkpoint.mark_best(tmp_path, tmp_path / "step-000000002.npz", (1.0, 6.0)), "and there is space again"
