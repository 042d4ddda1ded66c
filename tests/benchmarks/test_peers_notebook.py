"""What a training of the contest writes down."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from apex_bat.agent.inference import Policy, parameter_shapes
from apex_bat.config import Config
from benchmarks.peers.environments import Flat, unflatten
from benchmarks.peers.judging import parameters_in
from benchmarks.peers.notebook import Notebook, read

CONFIG = Config()
SHAPES = parameter_shapes(CONFIG.network, CONFIG.state_steps)


def made_up(seed: int) -> dict[str, NDArray[np.float32]]:
    generator = np.random.default_rng(seed)
    return {name: generator.normal(0.0, 1.0 / 30.0, shape).astype(np.float32) for name, shape in SHAPES.items()}


def act(flat: Flat, seed: int = 1) -> NDArray[np.int64]:
    policy = Policy(CONFIG.network, CONFIG.state_steps)
    policy.load(made_up(seed))
    return np.asarray(policy(unflatten(flat)).q.argmax(axis=1))


class Clock:
    """A time that the test sets."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_rows_are_written_at_fixed_times_and_once_when_the_budget_is_spent(tmp_path: Path) -> None:
    clock = Clock()
    notebook = Notebook(tmp_path, CONFIG, begin_s=90.0, budget_s=50.0, every_s=20.0, clock=clock)
    notebook.begin()
    ends = []
    for now_s in (100.0, 111.0, 129.0, 131.0, 139.0, 140.5, 141.0):
        clock.now_s = now_s
        ends.append(notebook.look(int(now_s), 2 * int(now_s), lambda: made_up(1), act))
    first, *rows = read(tmp_path)
    assert first == (10.0, 0, 0, "")
    assert [row.wall_s for row in rows] == [21.0, 41.0, 50.5]
    assert [row.env_steps for row in rows] == [111, 131, 140]
    assert [row.updates for row in rows] == [222, 262, 280]
    assert ends == [False] * 5 + [True, True]
    assert notebook.is_over
    found = parameters_in(tmp_path / rows[0].policy)
    np.testing.assert_array_equal(found["value.0.weight"], made_up(1)["value.0.weight"])


def test_a_policy_that_chooses_otherwise_than_the_librarys_is_refused(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path, CONFIG, begin_s=0.0, budget_s=1.0, every_s=1.0, clock=Clock())
    with pytest.raises(ValueError, match="chooses as the library's in"):
        notebook.look(1, 1, lambda: made_up(1), lambda flat: (act(flat) + 1) % 3)
    assert not read(tmp_path)


def test_nothing_written_is_no_rows(tmp_path: Path) -> None:
    assert read(tmp_path) == []
