"""Policies of the contest are judged by the flights of `apex-bat evaluate`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from apex_bat.agent.inference import parameter_shapes
from apex_bat.config import Config, load
from apex_bat.evaluation import runs
from apex_bat.roles import checkpoint
from apex_bat.roles.checkpoint import Checkpoint
from benchmarks.peers.judging import Judgement, fitting, judge, judge_course, parameters_in

CONFIG = load(None, ["evaluation.flights=6", "episode.evaluation_steps=12"])


def made_up(config: Config) -> dict[str, NDArray[np.float32]]:
    generator = np.random.default_rng(2)
    shapes = parameter_shapes(config.network, config.state_steps)
    return {name: generator.normal(0.0, 1.0 / 30.0, shape).astype(np.float32) for name, shape in shapes.items()}


def test_as_many_flights_are_completed_as_evaluate_says(tmp_path: Path) -> None:
    parameters = made_up(CONFIG)
    runs.create(tmp_path, CONFIG)
    arrays = {f"online/{name}": array for name, array in parameters.items()}
    path = checkpoint.save(tmp_path / "checkpoints", Checkpoint(7, checkpoint.fingerprint(CONFIG), {}, arrays), keep=1)
    result, _ = runs.evaluate(
        tmp_path, [CONFIG.arena], CONFIG.evaluation.flights, CONFIG.evaluation.start_seed, path=path
    )
    completed, progress_m = judge(parameters, CONFIG)
    assert completed == result["summary"][0]["completed"]
    assert progress_m == pytest.approx(result["summary"][0]["progress_m_mean"])
    assert 0 < completed < CONFIG.evaluation.flights, "or the test says nothing"
    found = parameters_in(path)
    assert found.keys() == parameters.keys()


def test_a_policy_with_wider_layers_is_judged_too() -> None:
    wide = load(None, ["network.hidden=[40]"])
    assert fitting(Config().network, made_up(wide)).hidden == (40,)
    deep = load(None, ["network.hidden=[40, 30]"])
    assert fitting(Config().network, made_up(deep)).hidden == (40, 30)


@pytest.mark.parametrize(
    ("completed", "expected"),
    [
        ([0, 3, 14, 9, 15, 14, 15, 15, 2], [0, 3, 14, 9, 15, 2]),
        ([0, 0, 0, 0, 0, 0, 0, 0, 14], [0, 0, 0, 0, 0, 0, 0, 0, 14]),
        ([15, 1, 2, 3, 4, 5, 6, 7, 8], [15, 1, 4, 7, 8]),
    ],
)
def test_all_policies_are_judged_until_one_completes_enough_and_then_a_few(
    completed: list[int], expected: list[int]
) -> None:
    files = {10.0 * (number + 1): Path(str(number)) for number in range(len(completed))}

    def judge_all(paths: Sequence[Path]) -> list[Judgement]:
        return [Judgement(completed[int(path.name)], 1.0) for path in paths]

    judged = judge_course(files, 14, 30.0, judge_all, together=2)
    assert [each.completed for each in judged.values()] == expected
    assert list(judged) == sorted(judged)
    assert all(completed[int(files[time_s].name)] == each.completed for time_s, each in judged.items())
