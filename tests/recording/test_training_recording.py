"""The course of a training is recorded as its rows say, and survives a kill."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import Chunk, RrdReader

from apex_bat.config import Config, load
from apex_bat.recording.blueprints import training_blueprint
from apex_bat.recording.curves import MEAN_S
from apex_bat.recording.priorities import MAP_SIZE
from apex_bat.recording.reading import is_whole, read_chunks
from apex_bat.recording.training import TRAINING_RECORDING, TrainingRecording
from apex_bat.replay.metrics import PRIORITY_BINS
from apex_bat.roles.metrics import DECLARED


def row(role: str, second: int, *, pid: int = 7, state: str = "busy", **figures: Any) -> dict[str, Any]:
    """A row of metrics, as the launcher writes it."""
    named = {name.replace("__", "."): value for name, value in figures.items()}
    totals = {"env_steps_total": 100.0 * second, "learner_step_total": 10.0 * second}
    return {
        "unix_s": 1e9 + second,
        "elapsed_s": float(second),
        "role": role,
        "pid": pid,
        "state": state,
        **totals,
        **named,
    }


def record(folder: Path, rows: list[dict[str, Any]], config: Config | None = None) -> list[Chunk]:
    """The chunks of the recording of some rows."""
    (folder / "recordings").mkdir(exist_ok=True)
    training = TrainingRecording(config or Config(actors=2), folder)
    for each in rows:
        training.take(each)
    training.close()
    return RrdReader(folder / "recordings" / TRAINING_RECORDING).stream().to_chunks()


def series(chunks: list[Chunk], entity: str, component: str = "Scalars:scalars", index: str = "elapsed") -> list[Any]:
    """(time, values) of an entity; times in s, or counts."""
    found: list[Any] = []
    for chunk in chunks:
        batch = chunk.to_record_batch()
        if chunk.entity_path == f"/{entity}" and component in batch.schema.names and not chunk.is_static:
            found += zip(batch.column(index).to_pylist(), batch.column(component).to_pylist(), strict=True)
    return [(time.total_seconds() if index == "elapsed" else time, values) for time, values in found]


def test_curves_hold_the_figures_of_the_rows(tmp_path: Path) -> None:
    chunks = record(tmp_path, [row("learner", second, loss=0.5 * second) for second in (1, 2, 3)])
    assert series(chunks, "learner/loss") == [(1.0, [0.5]), (2.0, [1.0]), (3.0, [1.5])]
    assert [time for time, _ in series(chunks, "learner/loss", index="env_steps")] == [100, 200, 300]
    assert [time for time, _ in series(chunks, "learner/loss", index="learner_step")] == [10, 20, 30]


def test_rates_of_the_replay_are_the_growth_of_its_counters(tmp_path: Path) -> None:
    rows = [row("replay", second, replay__inserted=30.0 * second, replay__sampled=8.0) for second in (1, 3)]
    assert series(record(tmp_path, rows), "replay/rate") == [(3.0, [30.0, 0.0])]


def test_counters_of_a_new_process_are_no_growth(tmp_path: Path) -> None:
    rows = [row("replay", 1, replay__inserted=30.0), row("replay", 2, pid=8, replay__inserted=0.0)]
    chunks = record(tmp_path, rows)
    assert series(chunks, "replay/rate") == []
    texts = [text for _, (text,) in series(chunks, "events", "TextLog:text")]
    assert texts == ["0:01 replay: process 7 started", "0:02 replay: process 8 took over"]


def test_returns_are_means_over_all_episodes_of_some_seconds(tmp_path: Path) -> None:
    later = int(MEAN_S) + 1
    rows = [
        row("actor-1", 1) | {"return": 1.0, "return_count": 3.0},
        row("actor-1", 2),
        row("actor-1", later) | {"return": 5.0, "return_count": 1.0},
    ]
    assert series(record(tmp_path, rows), "actor-1/return") == [(float(later), [2.0])]


def test_histogram_of_priorities_is_recorded_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    shares = {f"replay.priority_hist.{k}": 0.1 * k for k in reversed(range(PRIORITY_BINS))}
    chunks = record(tmp_path, [row("replay", 1) | shares])
    ((_, (histogram,)),) = series(chunks, "replay/priorities", "BarChart:values")
    np.testing.assert_allclose(histogram["buffer"], 0.1 * np.arange(PRIORITY_BINS), rtol=1e-6)
    ((time, (pixels,)),) = series(chunks, "replay/priorities/over_time", "DepthImage:buffer")
    assert time == 1.0
    assert series(chunks, "replay/priorities/over_time/times", "Points2D:labels") == [(1.0, ["0.0 min"] * 5)]
    column = np.array(pixels, np.uint8).view(np.float16).reshape(MAP_SIZE[::-1])[:, 0]
    np.testing.assert_allclose(column[::-2], 0.1 * np.arange(PRIORITY_BINS), rtol=1e-3)


def test_image_of_the_priorities_is_drawn_every_ten_seconds_whenever_rows_are_written(tmp_path: Path) -> None:
    shares = {f"replay.priority_hist.{k}": 0.0 for k in range(PRIORITY_BINS)}
    chunks = record(tmp_path, [row("replay", second) | shares for second in range(1, 25)])
    assert [time for time, _ in series(chunks, "replay/priorities/over_time", "DepthImage:buffer")] == [1.0, 11.0, 21.0]


def test_ladder_or_the_epsilon_of_all_is_recorded(tmp_path: Path) -> None:
    chunks = record(tmp_path, [row("learner", 1)])
    assert any(chunk.entity_path == "/exploration/ladder" for chunk in chunks)
    annealing = load(None, ["exploration.kind=anneal", "exploration.anneal_steps=200"])
    chunks = record(tmp_path, [row("learner", 1)], annealing)
    ((_, (epsilon,)),) = series(chunks, "exploration/epsilon")
    assert epsilon == pytest.approx((1.0 + 0.01) / 2)
    assert not any(chunk.entity_path == "/exploration/ladder" for chunk in chunks)


def test_judgements_are_events(tmp_path: Path) -> None:
    judged = row("evaluator", 9, state="judged it", learner_step=70.0, completed_share=0.5, progress_m=12.0)
    ((_, (_,)), (_, (text,))) = series(record(tmp_path, [judged]), "events", "TextLog:text")
    assert text == "0:09 update 70: 50 % complete, 12 m"


def test_rows_of_an_earlier_part_of_the_run_come_first(tmp_path: Path) -> None:
    (tmp_path / "metrics").mkdir()
    lines = [json.dumps(row("learner", second, loss=1.0)) for second in (1, 2)]
    (tmp_path / "metrics" / "learner.jsonl").write_text("\n".join(lines) + "\n" + '{"role": "lear')
    chunks = record(tmp_path, [row("learner", 3, loss=2.0)])
    assert [time for time, _ in series(chunks, "learner/loss")] == [1.0, 2.0, 3.0]


def test_layout_shows_every_actor() -> None:
    for config in (load(None, ["actors=3"]), load(None, ["exploration.kind=anneal"])):
        training_blueprint(config)


def test_recording_of_a_killed_launcher_is_readable(tmp_path: Path) -> None:
    (tmp_path / "recordings").mkdir()
    script = textwrap.dedent(f"""
        import os, signal
        from pathlib import Path
        from apex_bat.config import Config
        from apex_bat.recording import training
        training.FLUSH_PERIOD_S = 0.0
        recording = training.TrainingRecording(Config(), Path({str(tmp_path)!r}))
        for second in range(5):
            recording.take({{"unix_s": second, "elapsed_s": second, "role": "learner", "pid": 1, "state": "",
                             "env_steps_total": second, "learner_step_total": second, "loss": 1.0}})
        os.kill(os.getpid(), signal.SIGKILL)
    """)
    killed = subprocess.run([sys.executable, "-c", script], check=False, timeout=60)
    assert killed.returncode != 0
    path = tmp_path / "recordings" / TRAINING_RECORDING
    assert not is_whole(path)
    assert [values for _, values in series(read_chunks(path), "learner/loss")] == [[1.0]] * 5


def test_folder_that_cannot_be_written_costs_only_the_recording(tmp_path: Path) -> None:
    training = TrainingRecording(Config(), tmp_path / "nowhere")
    training.take(row("learner", 1, loss=1.0))
    training.close()


def test_document_lists_every_entity_that_is_written(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text(encoding="utf-8")
    common = row("x", 20, state="judged it", pid=3)
    rows = []
    for role, metrics in DECLARED.items():
        name = "actor-0" if role == "actor" else role
        for second in (1, 20):
            totals = {"unix_s": float(second), "elapsed_s": float(second), "role": name}
            rows.append(common | dict.fromkeys(metrics, 1.0 * second) | totals)
    entities = {chunk.entity_path.removeprefix("/") for chunk in record(tmp_path, rows)}
    assert len(entities) > 20
    for entity in entities:
        if not entity.startswith("__properties"):
            assert f"`{entity.replace('actor-0', 'actor-N')}`" in text, entity
