"""Verdicts: each rule on outcomes made for it."""

import math

import pytest

from apex_bat.config import Config, load
from apex_bat.evaluation.claims import RULES, findings, judge_number, judge_seeds, shown
from apex_bat.evaluation.groups import Group, group, thesis_groups
from apex_bat.evaluation.results import Judged, Protocol
from apex_bat.evaluation.statistics import Interval
from tests.evaluation.conftest import MakeJudged

PROTOCOL = Protocol()


def groups_of(judged: list[Judged]) -> dict[str, Group]:
    return thesis_groups(group(judged))


def like_the_thesis(make_judged: MakeJudged, config: Config | None = None) -> list[Judged]:
    """Three seeds of each condition with about the thesis's outcomes."""
    outcomes = {"memory": ((15, 15, 15), 0.8), "no_memory": ((10, 10, 10), 0.5), "onset": ((3, 3, 3), 0.2)}
    return [
        make_judged(condition, seed, completed=completed, straight=straight, config=config)
        for condition, (completed, straight) in outcomes.items()
        for seed in range(3)
    ]


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        (Interval(0.66, 0.60, 0.70, 3), "reproduced"),
        (Interval(0.66, 0.20, 0.99, 3), "not comparable"),  # too wide to say so
        (Interval(0.90, 0.85, 0.95, 3), "not reproduced"),
        (Interval(0.30, 0.20, 0.40, 3), "not reproduced"),
        (Interval(0.85, 0.75, 0.95, 3), "not comparable"),  # outside, but the interval reaches into the band
        (Interval(0.66, math.nan, math.nan, 1), "not comparable"),
    ],
)
def test_a_number_is_judged_by_its_interval_and_the_thesiss_band(interval: Interval, verdict: str) -> None:
    assert judge_number(interval, 0.66, (0.51, 0.78), widest=0.4)[0] == verdict


@pytest.mark.parametrize(
    ("num_so", "verdict"), [(6, "reproduced"), (4, "reproduced"), (3, "not comparable"), (2, "not comparable"),
                            (1, "not reproduced"), (0, "not reproduced")]
)  # fmt: skip
def test_a_test_is_judged_by_the_share_of_seeds_in_which_it_comes_out(num_so: int, verdict: str) -> None:
    assert judge_seeds(num_so, 6)[0] == verdict


def test_runs_like_the_thesis_reproduce_it(make_judged: MakeJudged) -> None:
    found = {each.claim: each for each in findings(groups_of(like_the_thesis(make_judged)), PROTOCOL)}
    assert len(found) == 17
    assert found["flights completed, memory"].verdict == "reproduced"
    assert found["flights completed, no_memory"].verdict == "reproduced"
    assert found["flights completed, no_memory"].ours.startswith("67 %")
    assert found["flights completed, onset"].verdict == "reproduced"
    assert found["Kruskal-Wallis on completed steps, narrow"].verdict == "reproduced"
    assert found["Kruskal-Wallis on share of straight actions, circle"].verdict == "reproduced"
    assert found["z-test of completed flights, memory v. no_memory, simple"].verdict == "reproduced"
    # distance: 150 m / ((10 x 150 + 5 x 15) / 15) = 1.43, near 1.5
    assert found["distance flown, memory / no_memory"].verdict == "reproduced"


def test_a_ratio_that_contradicts_the_thesiss_own_shares_is_not_comparable(make_judged: MakeJudged) -> None:
    # 21 % of flights over 150 m are 31.5 m on average and more: 150 m are not 6 times as much, whatever memory does.
    found = {each.claim: each for each in findings(groups_of(like_the_thesis(make_judged)), PROTOCOL)}
    row = found["distance flown, memory / onset"]
    assert row.verdict == "not comparable"
    assert row.reason == (
        "the thesis contradicts itself: with 21 % of flights completed by onset the ratio is at most 4.8"
    )
    assert row.ours.startswith("3."), "150 m over 42 m: ours is shown all the same"
    assert any("at most 4.8" in rule for rule in RULES)
    assert any("21 % is no number of 45 flights" in rule for rule in RULES)


def test_conditions_that_do_not_differ_reproduce_no_test(make_judged: MakeJudged) -> None:
    judged = [
        make_judged(name, seed, completed=(15, 15, 15))
        for name in ("memory", "no_memory", "onset")
        for seed in range(3)
    ]
    found = {each.claim: each for each in findings(groups_of(judged), PROTOCOL)}
    assert found["z-test of completed flights, memory v. no_memory, simple"].verdict == "not reproduced"
    assert found["Kruskal-Wallis on completed steps, simple"].ours == "no test possible: all flights ended alike"
    assert found["flights completed, memory"].verdict == "reproduced"
    assert found["flights completed, onset"].verdict == "not reproduced"


def test_a_difference_in_the_other_direction_is_not_the_thesiss(make_judged: MakeJudged) -> None:
    judged = [make_judged("memory", seed, completed=(5, 5, 5)) for seed in range(3)]
    judged += [make_judged("no_memory", seed, completed=(15, 15, 15)) for seed in range(3)]
    found = {each.claim: each for each in findings(groups_of(judged), PROTOCOL)}
    assert found["z-test of completed flights, memory v. no_memory, simple"].verdict == "not reproduced"


def test_conditions_in_another_order_are_not_the_thesiss(make_judged: MakeJudged) -> None:
    # As different as the thesis's, H alike, and onset best: H has no direction.
    outcomes = {"memory": ((3, 3, 3), 0.2), "no_memory": ((10, 10, 10), 0.5), "onset": ((15, 15, 15), 0.8)}
    judged = [
        make_judged(name, seed, completed=completed, straight=straight)
        for name, (completed, straight) in outcomes.items()
        for seed in range(3)
    ]
    rows = [each for each in findings(groups_of(judged), PROTOCOL) if each.claim.startswith("Kruskal")]
    assert len(rows) == 6
    assert {each.verdict for each in rows} == {"not reproduced"}
    assert float(rows[0].ours.removeprefix("H = ").split(",")[0]) > 16.0


def test_a_z_test_needs_the_direction_and_the_bound_of_p_not_the_extremity_that_the_thesis_found(
    make_judged: MakeJudged,
) -> None:
    # 15 against 11 of 15: z = 2.15, p = 0.03; the thesis says z > 2.4, p < 0.05.
    judged = [make_judged("memory", seed) for seed in range(3)]
    judged += [make_judged("no_memory", seed, completed=(11, 12, 10)) for seed in range(3)]
    found = {each.claim: each for each in findings(groups_of(judged), PROTOCOL)}
    name = "z-test of completed flights, memory v. no_memory, "
    assert found[name + "simple"].verdict == "reproduced"
    assert found[name + "simple"].ours == "z = 2.15, 2.15, 2.15; p at most 0.032"
    assert found[name + "simple"].thesis == "z > 2.4, p < 0.05"
    assert found[name + "narrow"].verdict == "not reproduced"  # z = 1.83, p = 0.07


def test_tests_are_paired_by_seed_and_a_seed_without_partner_is_named(make_judged: MakeJudged) -> None:
    # By seed 1, 2, 3 memory completes all and no_memory 10: what is left over must not shift that.
    judged = [make_judged("memory", seed, completed=(0, 15, 15)) for seed in (0, 0)]
    judged += [make_judged("memory", seed) for seed in (1, 2, 3)]
    judged += [make_judged("no_memory", seed, completed=(10, 10, 10)) for seed in (1, 2, 3)]
    judged += [make_judged("no_memory", seed, completed=(15, 15, 15)) for seed in (4, 5)]
    found = {each.claim: each for each in findings(groups_of(judged), PROTOCOL)}
    row = found["z-test of completed flights, memory v. no_memory, simple"]
    assert row.verdict == "reproduced"
    assert row.reason == "for 3 of 3 seeds; seeds without a partner: memory 0; no_memory 4, 5"
    apart = [each for each in judged if not (each.condition == "no_memory" and each.config.seed == 3)]
    found = {each.claim: each for each in findings(groups_of(apart), PROTOCOL)}
    row = found["z-test of completed flights, memory v. no_memory, simple"]
    assert row.verdict == "not comparable"
    assert row.reason.startswith(
        "fewer than 3 seeds that memory, no_memory share; seeds without a partner: memory 0, 3"
    )


def test_a_share_that_is_all_or_nothing_is_shown_with_wilsons_interval(make_judged: MakeJudged) -> None:
    judged = [make_judged("memory", seed) for seed in range(3)]
    row = findings(groups_of(judged), PROTOCOL)[0]
    assert row.ours == "100 % [97, 100]\u2021"
    assert row.verdict == "reproduced"


@pytest.mark.parametrize(
    "change", ["arena=circle", "body.speed_m_s=1.0", "rays.num_azimuth=50", "sonar.level_jitter_db=3.0",
               "sensing.memory_steps=5", "episode.near_m=0.5"]
)  # fmt: skip
def test_another_experiment_is_not_held_against_the_thesis(change: str, make_judged: MakeJudged) -> None:
    rows = findings(groups_of(like_the_thesis(make_judged, load(None, [change]))), PROTOCOL)
    assert {each.verdict for each in rows} == {"not comparable"}
    key, _, value = change.partition("=")
    assert rows[0].reason == f"another experiment than the thesis's: {key} {value}"


def test_other_ways_of_learning_are_held_against_the_thesis(make_judged: MakeJudged) -> None:
    config = load(None, ["learner.learning_rate=0.001", "actors=1", "rays.caster=pybullet"])
    rows = findings(groups_of(like_the_thesis(make_judged, config)), PROTOCOL)
    assert "reproduced" in {each.verdict for each in rows}


def test_the_order_in_which_arenas_are_named_does_not_matter(make_judged: MakeJudged) -> None:
    protocol = Protocol(("circle", "simple", "narrow"))
    rows = findings(groups_of(like_the_thesis(make_judged)), protocol)
    assert [each.verdict for each in rows] == [
        each.verdict for each in findings(groups_of(like_the_thesis(make_judged)), PROTOCOL)
    ]


def test_what_hinders_a_comparison_is_named(make_judged: MakeJudged) -> None:
    def reason(judged: list[Judged], protocol: Protocol = PROTOCOL) -> str:
        rows = findings(groups_of(judged), protocol)
        row = next(each for each in rows if each.claim == "distance flown, memory / no_memory")
        assert row.verdict == "not comparable"
        return row.reason

    full = like_the_thesis(make_judged)
    untrained = "no_memory not trained with the settings that are judged"
    assert reason([each for each in full if each.condition != "no_memory"]) == untrained
    assert reason([each for each in full if each.config.seed < 2]) == "fewer than 3 seeds (memory 2, no_memory 2)"
    assert "other flights" in reason(full, PROTOCOL._replace(num_flights=14))
    assert "other flights" in reason(full, PROTOCOL._replace(arenas=("simple", "narrow")))
    others = [each for each in full if each.condition != "memory"]
    for facts, words in (
        ({"env_steps": 200_000}, "trained for 180,000 to 200,000 steps"),
        ({"learner_steps": 20_000}, "trained for 20,000 to 22,000 updates"),
        ({"env_steps": None}, "unknown for how many steps memory-0, memory-1, memory-2 trained"),
        ({"learner_steps": None}, "unknown for how many updates memory-0, memory-1, memory-2 trained"),
        ({"outcome": "interrupted"}, "trainings that did not reach their end: memory-0 interrupted, memory-1 interr"),
        ({"outcome": None}, "trainings that did not reach their end: memory-0 unknown, "),
    ):
        changed = [make_judged("memory", seed, **facts) for seed in range(3)]
        assert reason([*changed, *others]).startswith(words)
    repeated = [make_judged("memory", seed) for seed in (0, 1, 1)]
    assert reason([*repeated, *others]) == "fewer than 3 seeds (memory 2)"


def test_intervals_from_few_seeds_are_marked() -> None:
    assert shown(Interval(0.5, 0.25, 0.75, 3), 100.0, " %") == "50 % [25, 75]"
    assert shown(Interval(0.5, 0.25, 0.75, 2), 100.0, " %") == "50 % [25, 75]\u2020"
    assert shown(Interval(0.5, math.nan, math.nan, 1), 100.0, " %") == "50 %"


def test_intervals_whose_resamples_are_all_alike_are_marked() -> None:
    assert shown(Interval(1.0, 0.97, 1.0, 3, is_wilson=True), 100.0, " %") == "100 % [97, 100]\u2021"
    assert shown(Interval(1.0, 1.0, 1.0, 2), 100.0, " points") == "100 points [100, 100]\u2020\u2021"


def test_the_rules_are_whole_sentences() -> None:
    assert all(rule.endswith(".") and "{" not in rule for rule in RULES)
