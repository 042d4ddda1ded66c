"""Campaigns: their order, their equal budgets, and how one that was cut short goes on."""

import json
from pathlib import Path

import pytest

from apex_bat.config import Config, ConfigError, load
from apex_bat.evaluation import reproduction, runs
from apex_bat.evaluation.reproduction import Planned, begin, clear, plan, train_all
from apex_bat.evaluation.results import Protocol

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
    with pytest.raises(ConfigError, match=r"learner.learning_rate: 0.0005 \| 0.1"):
        begin(folder, plan(folder, load(None, ["learner.learning_rate=0.1"]), CONDITIONS, 1, 100))
    # what does not change the experiment may change, and a first seed may be another
    begin(folder, plan(folder, load(None, ["seed=3", "recording.curves=false", "train.threads=2"]), CONDITIONS, 1, 100))
    facts = json.loads((folder / "campaign.json").read_text())
    del facts["settings"]["sensing"]["onset"]  # begun by a version that had no such setting
    (folder / "campaign.json").write_text(json.dumps(facts))
    begin(folder, plan(folder, Config(), CONDITIONS, 1, 100))
    (folder / "campaign.json").write_text('{"settings": {"nonsense": 1}}')
    with pytest.raises(ConfigError, match="none of this version"):
        begin(folder, plan(folder, Config(), CONDITIONS, 1, 100))
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


@pytest.mark.parametrize("name", ["max_minutes", "max_env_steps", "max_updates"])
def test_a_limit_that_the_budget_would_replace_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"train.{name}=3: trainings of a campaign end by --budget"):
        reproduction.refuse_limits(["seed=1", f"train.{name}=3"])
    reproduction.refuse_limits(["train.threads=2"])


def test_a_run_given_twice_is_refused_by_whatever_path(tmp_path: Path) -> None:
    (tmp_path / "memory-0").mkdir()
    (tmp_path / "same").symlink_to(tmp_path / "memory-0")
    for again in (tmp_path / "memory-0", tmp_path / "x" / ".." / "memory-0", tmp_path / "same"):
        with pytest.raises(runs.RunError, match="given twice"):
            reproduction.judge_all([tmp_path / "memory-0", again], tmp_path, Protocol(), lambda _: None)
