"""Campaigns: their order, their equal budgets, and how one that was cut short goes on."""

import json
from pathlib import Path

import pytest

from apex_bat.config import Config, ConfigError, load
from apex_bat.evaluation import reproduction, runs
from apex_bat.evaluation.reproduction import Planned, begin, clear, plan, train_all

CONDITIONS = ("memory", "onset")


def finish(each: Planned) -> None:
    runs.create(each.folder, each.config)
    runs.finish(each.folder, "completed", env_steps=100, learner_steps=10)


def test_seeds_are_interleaved_and_budgets_equal(tmp_path: Path) -> None:
    planned = plan(tmp_path, load(None, ["seed=3", "train.max_minutes=1.0"]), CONDITIONS, 2, budget=500)
    assert [each.folder.name for each in planned] == ["memory-3", "onset-3", "memory-4", "onset-4"]
    assert {each.config.train.max_env_steps for each in planned} == {500}
    assert {each.config.train.max_minutes for each in planned} == {None}
    assert len({each.config.replay.samples_per_insert for each in planned}) == 1
    assert [(each.config.condition, each.config.seed) for each in planned] == [
        ("memory", 3), ("onset", 3), ("memory", 4), ("onset", 4),
    ]  # fmt: skip


def test_a_campaign_goes_on_where_it_was(tmp_path: Path) -> None:
    planned, made, lines = plan(tmp_path, Config(), CONDITIONS, 2, 100), list[str](), list[str]()

    def train(each: Planned, title: str) -> bool:
        if len(made) == 2:
            return False  # interrupted
        made.append(each.folder.name)
        assert title.startswith(f"run {len(made)} of 4: ")
        finish(each)
        return True

    def train_rest(each: Planned, _: str) -> bool:
        made.append(each.folder.name)
        finish(each)
        return True

    assert not train_all(planned, train, lines.append)
    assert made == ["memory-0", "onset-0"]
    made.clear()
    assert train_all(planned, train_rest, lines.append)
    assert made == ["memory-1", "onset-1"]
    assert "run 1 of 4: memory, seed 0: is there" in lines


@pytest.mark.parametrize("left", ["running", "failed", "interrupted", None, "torn"])
def test_a_training_that_was_cut_off_begins_anew(tmp_path: Path, left: str | None) -> None:
    planned = plan(tmp_path, Config(), ("memory",), 1, 100)
    if left is None:
        planned[0].folder.mkdir()  # killed before run.json was written
    else:
        runs.create(planned[0].folder, planned[0].config)
        runs.note(planned[0].folder, outcome=left)
    if left == "torn":
        (planned[0].folder / "run.json").write_text("{")
    lines: list[str] = []

    def train(each: Planned, _: str) -> bool:
        clear(each.folder)
        assert not list(each.folder.iterdir())
        finish(each)
        return True

    assert train_all(planned, train, lines.append)
    assert lines == ["run 1 of 1: memory, seed 0: was cut off and begins anew"]
    assert planned[0].standing == "trained"


def test_time_left_is_told_from_the_runs_there_are(tmp_path: Path) -> None:
    planned = plan(tmp_path, Config(), CONDITIONS, 2, 100)
    for each in planned[:2]:
        finish(each)
        facts = {"start": "2026-01-01T00:00:00+00:00", "end": "2026-01-01T00:11:00+00:00", "outcome": "completed"}
        (each.folder / "run.json").write_text(json.dumps(facts))
    titles: list[str] = []

    def train(each: Planned, title: str) -> bool:
        titles.append(title)
        finish(each)
        return True

    train_all(planned, train, lambda _: None)
    assert titles[0] == "run 3 of 4: memory, seed 1, about 22 min left"


def test_a_folder_holds_one_campaign(tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    begin(folder, plan(folder, Config(), CONDITIONS, 1, 100))
    begin(folder, plan(folder, Config(), ("memory",), 5, 100))  # more seeds or fewer conditions are the same campaign
    with pytest.raises(ConfigError, match="other settings"):
        begin(folder, plan(folder, Config(), CONDITIONS, 1, 200))
    with pytest.raises(ConfigError, match="other settings"):
        begin(folder, plan(folder, load(None, ["learner.learning_rate=0.1"]), CONDITIONS, 1, 100))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("")
    with pytest.raises(runs.RunError, match="no campaign"):
        begin(tmp_path / "other", plan(folder, Config(), CONDITIONS, 1, 100))


@pytest.mark.parametrize(
    ("conditions", "overrides", "says"),
    [(("sight",), [], "no such condition"), ((), [], "at least one"), (("memory", "memory"), [], "each once"),
     (("memory",), ["replay.never_block=true"], "samples per insert")],
)  # fmt: skip
def test_what_would_not_be_comparable_is_refused(
    tmp_path: Path, conditions: tuple[str, ...], overrides: list[str], says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        reproduction.plan(tmp_path, load(None, overrides), conditions, 1, 100)
