"""Groups: runs that may be compared, and those that may not."""

from apex_bat.config import load
from apex_bat.evaluation.groups import group, long_labels, thesis_groups
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


def test_the_default_is_the_reference_however_many_other_runs_there_are(make_judged: MakeJudged) -> None:
    other = load(None, ["sensing.memory_steps=5"])
    judged = [make_judged("memory", seed) for seed in range(3)]
    judged += [make_judged("memory", seed, config=other) for seed in range(5)]
    groups = group(judged)
    assert [(each.label, each.num_seeds) for each in groups] == [("memory", 3), ("memory (sensing.memory_steps 5)", 5)]
    assert thesis_groups(groups)["memory"].num_seeds == 3
    assert group(judged[3:])[0].label == "memory (sensing.memory_steps 5)", "also where all runs have it"


def test_settings_that_all_runs_share_may_be_held_against_the_thesis_and_several_not(make_judged: MakeJudged) -> None:
    slow, fast = load(None, ["learner.learning_rate=0.0001"]), load(None, ["learner.learning_rate=0.001"])
    all_slow = [make_judged(name, seed, config=slow) for name in ("memory", "onset") for seed in range(3)]
    chosen = thesis_groups(group(all_slow))
    assert {name: each.label for name, each in chosen.items()} == {
        "memory": "memory (learner.learning_rate 0.0001)", "onset": "onset (learner.learning_rate 0.0001)",
    }  # fmt: skip
    assert thesis_groups(group([*all_slow, make_judged("onset", config=fast)])) == {}


def test_a_label_counts_many_settings_and_they_are_listed_elsewhere(make_judged: MakeJudged) -> None:
    changes = ["actors=1", "bats_per_actor=1", "learner.batch_size=32", "learner.num_step=1"]
    judged = [make_judged("memory", config=load(None, changes))]
    judged += [make_judged("memory", config=load(None, [*changes[:3], "learner.num_step=2"]))]
    groups = group(judged)
    assert all(each.label.startswith("memory (4 other settings, ") for each in groups)
    assert groups[0].label != groups[1].label
    assert (
        long_labels(groups)[groups[0].label] == "actors 1, bats_per_actor 1, learner.batch_size 32, learner.num_step 1"
    )


def test_a_seed_trained_twice_is_one_seed(make_judged: MakeJudged) -> None:
    twice = [make_judged("memory", 0, completed=(15, 15, 15)), make_judged("memory", 0, completed=(5, 15, 15))]
    only = group([*twice, make_judged("memory", 1, completed=(10, 15, 15))])[0]
    assert (only.seeds, only.num_seeds, len(only.runs)) == ([0, 1], 2, 3)
    scores = only.scores(["simple"], lambda each: float(each.completed))
    assert scores.shape == (2, 1, 15)
    assert scores[0, 0].tolist() == [1.0] * 5 + [0.5] * 10, "the mean over both runs, flight by flight"
    assert only.first_of(0) is only.runs[0]
