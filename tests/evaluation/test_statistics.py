"""Statistics: each against a value that was computed elsewhere or by hand."""

import math

import numpy as np
import pytest

from apex_bat.evaluation import statistics


def cells(*values: float) -> statistics.Floats:
    """Cells of seeds in one arena."""
    return np.array(values, float)[:, None]


def test_kruskal_wallis_agrees_with_the_example_of_scipys_documentation() -> None:
    test = statistics.kruskal_wallis([np.array([1.0, 3, 5, 7, 9]), np.array([2.0, 4, 6, 8, 10])])
    assert test.statistic == pytest.approx(0.2727272727272734)
    assert test.p == pytest.approx(0.6015081344405895)


def test_kruskal_wallis_agrees_with_a_case_reckoned_by_hand() -> None:
    # Ranks 1 2 3 | 4 5 6 | 7 8 9: H = 12 / (9 * 10) * (6^2 + 15^2 + 24^2) / 3 - 3 * 10 = 7.2; p = exp(-3.6) for 2 df.
    test = statistics.kruskal_wallis([np.array([1.0, 2, 3]), np.array([4.0, 5, 6]), np.array([7.0, 8, 9])])
    assert test.statistic == pytest.approx(7.2)
    assert test.p == pytest.approx(math.exp(-3.6))


def test_kruskal_wallis_of_equal_values_is_not_made() -> None:
    assert math.isnan(statistics.kruskal_wallis([np.full(3, 1000.0), np.full(3, 1000.0)]).statistic)


def test_proportions_agree_with_the_example_of_statsmodels_documentation() -> None:
    test = statistics.proportions_z(5, 83, 12, 99)
    assert test.statistic == pytest.approx(-1.4078304151258787)
    assert test.p == pytest.approx(0.15918129181156992)


def test_proportions_agree_with_the_formula_and_show_where_the_thesis_has_its_bound() -> None:
    # 15 of 15 against 10 of 15: pooled 25/30, z = (1/3) / sqrt(25/30 * 5/30 * 2/15) = 2.449; the thesis: z > 2.4.
    test = statistics.proportions_z(15, 15, 10, 15)
    assert test.statistic == pytest.approx((1 / 3) / math.sqrt(25 / 30 * 5 / 30 * 2 / 15))
    assert test.p == pytest.approx(math.erfc(test.statistic / math.sqrt(2)))
    assert statistics.proportions_z(10, 15, 15, 15).statistic == pytest.approx(-test.statistic)


def test_proportions_that_are_all_or_nothing_are_not_tested() -> None:
    assert math.isnan(statistics.proportions_z(15, 15, 15, 15).statistic)
    assert math.isnan(statistics.proportions_z(0, 15, 0, 15).p)


def test_wilson_interval_agrees_with_newcombe() -> None:
    # Newcombe (1998), table I: 81 of 263 is 0.2553 to 0.3662, 0 of 20 is 0 to 0.1611.
    assert statistics.wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert statistics.wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    for total in range(1, 60):
        assert f"{statistics.wilson_interval(0, total)[0]:.0f}" == "0", "and not -0"
        assert statistics.wilson_interval(total, total)[1] <= 1.0


def test_interquartile_mean_drops_the_outer_quarters() -> None:
    assert statistics.interquartile_mean(cells(0, 1, 2, 3, 4, 5, 6, 100)) == pytest.approx((2 + 3 + 4 + 5) / 4)
    assert statistics.interquartile_mean(np.array([[0.0, 1], [2, 100]])) == pytest.approx(1.5)


def test_probability_of_improvement_counts_pairs_within_each_arena_and_ties_half() -> None:
    assert statistics.probability_of_improvement(cells(1, 2, 3), cells(0, 2)) == pytest.approx((1 + 1.5 + 2) / 6)
    first, second = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 1.0], [0.0, 1.0]])
    assert statistics.probability_of_improvement(first, second) == 0.5
    assert statistics.probability_of_improvement(second, second) == 0.5


def test_hedges_g_agrees_with_a_case_reckoned_by_hand() -> None:
    # Means 3 and 1, both variances 1: d = 2, freedom 4, correction 1 - 3 / 15 = 0.8.
    assert statistics.hedges_g(cells(2, 3, 4), cells(0, 1, 2)) == pytest.approx(1.6)
    assert math.isnan(statistics.hedges_g(cells(1), cells(0, 1)))
    assert math.isnan(statistics.hedges_g(cells(1, 1), cells(0, 0)))


def test_permutation_agrees_with_counting() -> None:
    # Of 20 ways to choose 3 of 6 seeds one is as good and one as bad; the greatest difference has p = 2 / 20.
    assert statistics.permutation_p(cells(4, 5, 6), cells(1, 2, 3)) == pytest.approx(0.1)
    assert statistics.least_p(3, 3) == pytest.approx(0.1)
    assert statistics.permutation_p(cells(5, 6, 7), cells(1, 2)) == pytest.approx(statistics.least_p(3, 2))
    assert math.isnan(statistics.permutation_p(cells(1), cells(1, 2)))


def test_holm_agrees_with_a_case_reckoned_by_hand() -> None:
    # Sorted 0.01, 0.02, 0.04 times 3, 2, 1 = 0.03, 0.04, 0.04, made to rise.
    assert statistics.holm([0.04, 0.01, 0.02]) == pytest.approx([0.04, 0.03, 0.04])
    assert statistics.holm([0.6, 0.9]) == [1.0, 1.0]
    corrected = statistics.holm([0.01, math.nan])
    assert corrected[0] == pytest.approx(0.01)
    assert math.isnan(corrected[1])


def test_ratio_over_nothing_is_no_number() -> None:
    assert math.isnan(statistics.ratio(cells(1.0), cells(0.0)))
    assert statistics.ratio(cells(3.0), cells(2.0)) == 1.5


def test_bootstrap_interval_agrees_with_the_spread_of_means_of_many_seeds() -> None:
    chance = np.random.default_rng(3)
    seeds = chance.normal(10.0, 2.0, 200)
    scores = np.repeat(seeds[:, None, None], 4, axis=2)  # flights of a seed are alike: only seeds spread
    interval = statistics.bootstrap(statistics.mean, [scores])
    half = 1.96 * seeds.std() / math.sqrt(len(seeds))
    assert interval.estimate == pytest.approx(seeds.mean())
    assert interval.low == pytest.approx(seeds.mean() - half, abs=0.05)
    assert interval.high == pytest.approx(seeds.mean() + half, abs=0.05)


def test_flights_do_not_count_as_seeds() -> None:
    # Two seeds, one that completes everything and one nothing: 15 flights each do not make the interval narrow.
    scores = np.stack([np.ones((1, 15)), np.zeros((1, 15))])
    interval = statistics.bootstrap(statistics.mean, [scores])
    assert (interval.low, interval.high) == (0.0, 1.0)
    assert interval.is_weak


def test_flights_are_drawn_within_a_seed() -> None:
    scores = np.tile(np.array([1.0, 0.0] * 8), (3, 1, 1))  # equal seeds: all spread is that of flights
    interval = statistics.bootstrap(statistics.mean, [scores])
    # 16 draws of 0 or 1, the same for all seeds, because flight k of each began at the same pose: sd 0.125
    assert interval.low == pytest.approx(0.5 - 1.96 * 0.125, abs=0.03)
    assert interval.high == pytest.approx(0.5 + 1.96 * 0.125, abs=0.03)


def test_starts_are_drawn_once_for_both_conditions_and_for_baselines() -> None:
    # Two conditions that are alike but for one point: hard starts are hard for both, and their difference is sure.
    scores = np.tile(np.array([1.0, 0.0] * 8), (3, 2, 1))
    for split in (([scores + 1.0, scores],), ([scores + 1.0], [scores[:1]])):
        interval = statistics.bootstrap(statistics.difference, *split)
        assert (interval.low, interval.estimate, interval.high) == pytest.approx((1.0, 1.0, 1.0))


def test_a_share_of_flights_that_all_ended_alike_has_wilsons_interval() -> None:
    interval = statistics.bootstrap_share(np.ones((3, 3, 15)))
    assert (interval.low, interval.high) == pytest.approx(statistics.wilson_interval(135, 135))
    assert interval.low < 0.99
    assert interval.is_wilson
    mixed = np.ones((3, 3, 15))
    mixed[0, 0, 0] = 0.0
    assert not statistics.bootstrap_share(mixed).is_alike
    assert statistics.bootstrap_share(mixed) == statistics.bootstrap(statistics.mean, [mixed])
    assert not statistics.bootstrap_share(np.ones((1, 3, 15))).is_given, "one seed has no interval of any kind"


def test_an_interval_without_width_is_known_as_one() -> None:
    apart = statistics.bootstrap(statistics.difference, [np.ones((3, 1, 15)), np.zeros((3, 1, 15))])
    assert apart.is_alike
    assert not statistics.bootstrap(statistics.mean, [np.ones((1, 1, 15))]).is_alike


def test_one_seed_gives_no_interval() -> None:
    interval = statistics.bootstrap(statistics.mean, [np.ones((1, 3, 15))])
    assert interval.estimate == 1.0
    assert not interval.is_given


def test_a_baseline_is_one_and_does_not_make_an_interval_weak() -> None:
    scores = np.random.default_rng(0).random((3, 2, 15))
    interval = statistics.bootstrap(statistics.difference, [scores], [np.zeros((1, 2, 15))])
    assert interval.num_seeds == 3
    assert not interval.is_weak
    assert interval.low < interval.estimate < interval.high
    assert not statistics.bootstrap(statistics.difference, [scores, np.zeros((1, 2, 15))]).is_given


def test_equal_seeds_of_resampling_give_equal_intervals() -> None:
    scores = np.random.default_rng(0).random((4, 2, 15))
    assert statistics.bootstrap(statistics.mean, [scores]) == statistics.bootstrap(statistics.mean, [scores])
