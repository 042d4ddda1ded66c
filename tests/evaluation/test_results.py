"""What is kept of judged flights, and when they are flown again."""

from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import load
from apex_bat.evaluation import results
from apex_bat.evaluation.results import Protocol, judge_baseline, read_curve

CONFIG = load(None, ["episode.evaluation_steps=20", "sonar.rendering=exact"])
PROTOCOL = Protocol(("simple", "circle"), num_flights=2, start_seed=4)


def test_flights_are_kept_step_by_step_and_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = judge_baseline("straight", CONFIG, tmp_path, PROTOCOL)
    monkeypatch.setattr(results, "fly", None)  # what is there is not flown again
    again = judge_baseline("straight", CONFIG, tmp_path, PROTOCOL)
    assert again.records == first.records
    assert [record.arena for record in again.records] == ["simple", "simple", "circle", "circle"]
    for record, trace in zip(again.records, again.traces, strict=True):
        assert len(trace.actions) == len(trace.clearance_m) == record.steps == len(trace.poses) - 1
        np.testing.assert_allclose(trace.poses[0], record.start, rtol=1e-5)
        way_m = np.hypot(*np.diff(trace.poses[:, :2], axis=0).T).sum()
        assert way_m == pytest.approx(record.distance_m, rel=0.2)
    assert again.scores(PROTOCOL.arenas, lambda record: record.flight).tolist() == [[0.0, 1.0], [0.0, 1.0]]


def test_another_protocol_or_another_world_is_flown_anew(tmp_path: Path) -> None:
    judge_baseline("straight", CONFIG, tmp_path, PROTOCOL)
    other = judge_baseline("straight", CONFIG, tmp_path, PROTOCOL._replace(start_seed=5))
    assert other.records[0].start != judge_baseline("straight", CONFIG, tmp_path, PROTOCOL).records[0].start
    faster = load(None, ["episode.evaluation_steps=20", "sonar.rendering=exact", "body.speed_m_s=1.0"])
    assert judge_baseline("straight", faster, tmp_path, PROTOCOL).records[0].distance_m < 1.01


def test_flights_of_another_version_of_the_code_are_flown_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judge_baseline("straight", CONFIG, tmp_path, PROTOCOL)
    monkeypatch.setattr(results, "FLIGHTS_VERSION", results.FLIGHTS_VERSION + 1)
    monkeypatch.setattr(results, "fly", None)
    with pytest.raises(TypeError):  # it flies
        judge_baseline("straight", CONFIG, tmp_path, PROTOCOL)


def test_torn_files_are_flown_anew(tmp_path: Path) -> None:
    first = judge_baseline("straight", CONFIG, tmp_path, PROTOCOL)
    path = tmp_path / "straight.npz"
    path.write_bytes(path.read_bytes()[:-100])
    assert judge_baseline("straight", CONFIG, tmp_path, PROTOCOL).records == first.records


def test_the_curve_has_a_point_for_each_judged_checkpoint(tmp_path: Path) -> None:
    (tmp_path / "metrics").mkdir()
    rows = [
        '{"env_steps_total": 10}',
        '{"env_steps_total": 20, "learner_step": 5, "completed_share": 0.2, "progress_m": 3.0}',
        '{"env_steps_total": 30, "learner_step": 5, "completed_share": 0.2, "progress_m": 3.0}',
        '{"env_steps_total": 40, "learner_step": 9, "completed_share": 0.8, "progress_m": 9.0}',
    ]
    (tmp_path / "metrics" / "evaluator.jsonl").write_text("\n".join(rows) + "\n")
    curve = read_curve(tmp_path)
    assert curve is not None
    assert curve.env_steps.tolist() == [20.0, 40.0]
    assert curve.completed_share.tolist() == [0.2, 0.8]
    assert read_curve(tmp_path / "nowhere") is None
