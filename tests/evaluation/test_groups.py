"""Groups: runs that may be compared, and those that may not."""

from apex_bat.config import load
from apex_bat.evaluation.groups import group, thesis_groups
from tests.evaluation.conftest import MakeJudged


def test_runs_that_differ_by_seed_and_condition_only_are_grouped_by_condition(make_judged: MakeJudged) -> None:
    judged = [make_judged(name, seed) for seed in (1, 0) for name in ("onset", "memory")]
    groups = group(judged, [make_judged("memory")])
    assert [each.label for each in groups[:2]] == ["memory", "onset"]
    assert [run.config.seed for run in groups[0].runs] == [0, 1]
    assert [each.is_trained for each in groups] == [True, True, False]


def test_a_run_with_other_settings_is_a_group_of_its_own(make_judged: MakeJudged) -> None:
    other = load(None, ["learner.learning_rate=0.001", "train.max_minutes=99.0"])
    judged = [make_judged("memory", seed) for seed in range(3)] + [make_judged("memory", 3, config=other)]
    groups = group(judged)
    assert [each.label for each in groups] == ["memory", "memory (learner.learning_rate 0.001)"]
    assert set(thesis_groups(groups)) == {"memory"}
    assert thesis_groups(groups)["memory"].num_seeds == 3
