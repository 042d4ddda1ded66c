"""Verdicts: each rule on outcomes made for it."""

import math

import pytest

from apex_bat.evaluation.claims import RULES, findings, judge_number, judge_seeds, shown
from apex_bat.evaluation.groups import Group, group, thesis_groups
from apex_bat.evaluation.results import Judged, Protocol
from apex_bat.evaluation.statistics import Interval
from tests.evaluation.conftest import MakeJudged

PROTOCOL = Protocol()


def groups_of(judged: list[Judged]) -> dict[str, Group]:
    return thesis_groups(group(judged))


def like_the_thesis(make_judged: MakeJudged, **facts: int) -> list[Judged]:
    """Three seeds of each condition with about the thesis's outcomes."""
    outcomes = {"memory": ((15, 15, 15), 0.8), "no_memory": ((10, 10, 10), 0.5), "onset": ((3, 3, 3), 0.2)}
    return [
        make_judged(condition, seed, completed=completed, straight=straight, **facts)
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
    # distance: (150 m) / (10 x 150 + 5 x 15) / 15 = 1.43, near 1.5; memory / onset: 150 / 42 = 3.6, far from 6
    assert found["distance flown, memory / no_memory"].verdict == "reproduced"
    assert found["distance flown, memory / onset"].verdict == "not reproduced"


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


def test_what_hinders_a_comparison_is_named(make_judged: MakeJudged) -> None:
    def reason(judged: list[Judged], protocol: Protocol = PROTOCOL) -> str:
        rows = findings(groups_of(judged), protocol)
        row = next(each for each in rows if each.claim == "distance flown, memory / no_memory")
        assert row.verdict == "not comparable"
        return row.reason

    full = like_the_thesis(make_judged)
    assert reason([each for each in full if each.condition != "no_memory"]) == "no_memory not trained"
    assert reason([each for each in full if each.config.seed < 2]) == "fewer than 3 seeds (memory 2, no_memory 2)"
    assert "other flights" in reason(full, PROTOCOL._replace(num_flights=14))
    assert "other flights" in reason(full, PROTOCOL._replace(arenas=("simple", "narrow")))
    longer = [make_judged("memory", seed, env_steps=200_000) for seed in range(3)]
    assert "180,000 to 200,000 steps" in reason([*longer, *(each for each in full if each.condition != "memory")])


def test_intervals_from_few_seeds_are_marked() -> None:
    assert shown(Interval(0.5, 0.25, 0.75, 3), 100.0, " %") == "50 % [25, 75]"
    assert shown(Interval(0.5, 0.25, 0.75, 2), 100.0, " %") == "50 % [25, 75]\u2020"
    assert shown(Interval(0.5, math.nan, math.nan, 1), 100.0, " %") == "50 %"


def test_the_rules_are_whole_sentences() -> None:
    assert all(rule.endswith(".") and "{" not in rule for rule in RULES)
