"""What keeps runs from being compared."""

from pathlib import Path

from apex_bat.config import load
from apex_bat.evaluation.groups import group, settings_apart, thesis_groups
from apex_bat.evaluation.obstacles import SAME_WORLD, obstacle, unequal_training
from apex_bat.evaluation.results import Protocol
from tests.evaluation.conftest import MakeJudged

THESIS = Path(__file__).resolve().parents[2] / "configs" / "thesis.toml"


def test_the_default_is_the_thesiss_experiment(make_judged: MakeJudged) -> None:
    apart = settings_apart(load(THESIS))
    assert apart, "the thesis learned in another way"
    groups = thesis_groups(group([make_judged("memory", seed, config=load(THESIS)) for seed in range(3)]))
    assert obstacle(["memory"], groups, Protocol()) == ""
    assert SAME_WORLD == ("rays.caster",)


def test_runs_trained_alike_long_are_not_unequal(make_judged: MakeJudged) -> None:
    runs = [make_judged("memory"), make_judged("onset", env_steps=188_000, learner_steps=22_900)]
    assert unequal_training(runs) == ""
    assert unequal_training([*runs, make_judged("onset", env_steps=190_000)]) == "trained for 180,000 to 190,000 steps"


def test_zero_steps_are_a_length_and_none_is_not(make_judged: MakeJudged) -> None:
    assert unequal_training([make_judged("memory", env_steps=0)]) == ""
    assert unequal_training([make_judged("memory", env_steps=None)]).startswith("unknown for how many steps memory-0")
