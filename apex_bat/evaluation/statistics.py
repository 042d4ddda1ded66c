"""Statistics of conditions: the thesis's own tests on flights, and sound ones whose unit is the seed.

A trained policy flies many times, but it was trained once: its flights are no independent evidence on the training.
The thesis's tests take the flight as the unit, so they are made here for one seed at a time, as a repetition of the
thesis's experiment. What is said of a condition takes the seed as the unit: intervals by a hierarchical bootstrap, that
draws seeds, and flights by their starts, which all seeds and conditions share; the interquartile mean and the
probability of improvement as defined by Agarwal et al. (2021, "Deep reinforcement learning at the edge of the
statistical precipice", NeurIPS) and computed by
their rliable; permutation tests of seeds, corrected for their number by Holm (1979).

Scores of a condition are float64 (seeds, arenas, flights), their means over flights *cells* (seeds, arenas). Statistics
take cells, with any axes before those two, so that all resamples are reckoned at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Floats = NDArray[np.float64]
Statistic = Callable[..., Floats]
"""Of the cells of one or more conditions, float64 (..., seeds, arenas) each; returns (...)."""

NUM_RESAMPLES = 2000
CONFIDENCE = 0.95
ENOUGH_SEEDS = 3
"""An interval from fewer seeds is marked as such: a bootstrap of two knows nothing of what a third would be."""
COVERAGE_SPREADS = (0.02, 0.1, 0.2)
COVERAGE = {3: (0.99, 0.94, 0.86), 5: (0.99, 0.96, 0.91)}
"""How often an interval that is called 95 % holds the true share, by the number of seeds, when the shares of seeds have
the standard deviations `COVERAGE_SPREADS`: 1000 simulated experiments each, a mean share of 0.66, three arenas of 15
flights that do not depend on their starts."""
LEAST_FOR_IQM = 4
"""Values below which the interquartile mean leaves none out and is the plain mean."""


class Test(NamedTuple):
    """Outcome of a test."""

    statistic: float
    """NaN where the data do not allow the test, for example when all values are equal."""
    p: float


class Interval(NamedTuple):
    """An estimate and its 95 % interval."""

    estimate: float
    low: float
    """NaN without an interval: one seed tells nothing of the spread over seeds."""
    high: float
    num_seeds: int
    """Of the condition with the fewest."""
    is_wilson: bool = False
    """Whether it is Wilson's, of a share whose flights all ended alike."""

    @property
    def is_given(self) -> bool:
        """Whether there is an interval."""
        return bool(np.isfinite(self.low))

    @property
    def is_weak(self) -> bool:
        """Whether there are too few seeds for the interval to be trusted."""
        return self.num_seeds < ENOUGH_SEEDS

    @property
    def is_alike(self) -> bool:
        """Whether no resample differed from another, so that they do not tell how sure the estimate is."""
        return self.is_wilson or (self.is_given and math.isclose(self.low, self.high, rel_tol=1e-6, abs_tol=1e-9))


def kruskal_wallis(samples: Sequence[Floats]) -> Test:
    """Returns the Kruskal-Wallis H test of several samples (n,), corrected for ties."""
    if len(samples) < 2 or len(np.unique(np.concatenate(samples))) < 2:
        return Test(float("nan"), float("nan"))
    result = stats.kruskal(*samples)
    return Test(float(result.statistic), float(result.pvalue))


def proportions_z(first: int, num_first: int, second: int, num_second: int) -> Test:
    """Returns the two-sided z-test of two proportions with pooled variance; z > 0 when the first is greater.

    Its square is the chi-squared of the 2 x 2 table without Yates's correction, which scipy computes.
    """
    table = np.array([[first, num_first - first], [second, num_second - second]])
    if (table.sum(axis=0) == 0).any():  # all completed, or none: the pooled variance is 0
        return Test(float("nan"), float("nan"))
    result = stats.chi2_contingency(table, correction=False)
    sign = np.sign(first / num_first - second / num_second)
    return Test(float(sign * np.sqrt(result.statistic)), float(result.pvalue))


def wilson_interval(count: float, total: int) -> tuple[float, float]:
    """Returns Wilson's 95 % interval of a proportion of independent trials."""
    z = float(stats.norm.ppf(0.5 + CONFIDENCE / 2))
    share = count / total
    middle = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z / (1 + z**2 / total) * np.sqrt(share * (1 - share) / total + z**2 / (4 * total**2))
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))  # rounding goes a little beyond


def cells_of(scores: Floats) -> Floats:
    """Returns the means over flights: float64 (seeds, arenas) of scores (seeds, arenas, flights)."""
    return np.asarray(scores.mean(axis=-1))


def mean(cells: Floats) -> Floats:
    """Returns the mean over seeds and arenas."""
    return np.asarray(cells.mean(axis=(-2, -1)))


def interquartile_mean(cells: Floats) -> Floats:
    """Returns the mean of the middle half of the values of all seeds and arenas (rliable's IQM)."""
    values = cells.reshape(*cells.shape[:-2], -1)
    return np.asarray(stats.trim_mean(values, proportiontocut=0.25, axis=-1))


def difference(first: Floats, second: Floats) -> Floats:
    """Returns the mean of the first less that of the second."""
    return mean(first) - mean(second)


def ratio(first: Floats, second: Floats) -> Floats:
    """Returns the mean of the first over that of the second; NaN over 0."""
    above, below = np.broadcast_arrays(mean(first), mean(second))
    return np.asarray(np.divide(above, below, out=np.full(above.shape, np.nan), where=below != 0.0))


def probability_of_improvement(first: Floats, second: Floats) -> Floats:
    """Returns how probably a seed of the first scores above one of the second in an arena, ties counted half.

    As in rliable: the Mann-Whitney U of each arena over the number of pairs, then the mean over arenas.
    """
    ours, theirs = first[..., :, None, :], second[..., None, :, :]
    return np.asarray(((ours > theirs) + 0.5 * (ours == theirs)).mean(axis=(-3, -2, -1)))


def hedges_g(first: Floats, second: Floats) -> float:
    """Returns the difference of two conditions in standard deviations between seeds, corrected for few of them.

    NaN with fewer than two seeds in either, or where no seed differs from another.
    """
    ours, theirs = first.mean(axis=1), second.mean(axis=1)
    if min(len(ours), len(theirs)) < 2:
        return float("nan")
    freedom = len(ours) + len(theirs) - 2
    pooled = math.sqrt(((len(ours) - 1) * ours.var(ddof=1) + (len(theirs) - 1) * theirs.var(ddof=1)) / freedom)
    correction = 1.0 - 3.0 / (4.0 * freedom - 1.0)
    apart = float(ours.mean() - theirs.mean())
    return correction * apart / pooled if pooled > 0.0 else float("nan")


def bootstrap(
    statistic: Statistic, trained: Sequence[Floats], baselines: Sequence[Floats] = (), seed: int = 0
) -> Interval:
    """Returns a statistic with its hierarchical bootstrap interval (percentiles).

    Each resample draws, for each condition apart (the strata), as many seeds as there are, with replacement; a seed
    keeps its arenas together, because one policy flew in all of them. And it draws as many starts of each arena as
    there are, once for all seeds, conditions and baselines: flight k of each of them began at the same pose, so that a
    set of hard starts is hard for all.

    Args:
        statistic: of the cells of all conditions, the trained ones first.
        trained: scores of conditions, flown from the same starts; one with a single seed allows no interval.
        baselines: scores of pilots that learn nothing, flown from them too; there is one of each.
        seed: of the resampling.
    """
    num_seeds = min(len(scores) for scores in trained)
    estimate = float(statistic(*(cells_of(scores) for scores in (*trained, *baselines))))
    if num_seeds < 2:
        return Interval(estimate, math.nan, math.nan, num_seeds)
    generator = np.random.default_rng(seed)
    starts = generator.integers(trained[0].shape[2], size=(NUM_RESAMPLES, *trained[0].shape[1:]))
    drawn = statistic(*(_resample(scores, starts, generator) for scores in (*trained, *baselines)))
    if not np.isfinite(drawn).any():
        return Interval(estimate, math.nan, math.nan, num_seeds)
    tail = 100.0 * (1.0 - CONFIDENCE) / 2
    low, high = np.nanpercentile(drawn, [tail, 100.0 - tail])
    return Interval(estimate, float(low), float(high), num_seeds)


def bootstrap_share(scores: Floats) -> Interval:
    """Returns the share of flights with its interval: the bootstrap's, or Wilson's where all flights ended alike.

    There every resample is the same, and its interval would have no width. Wilson's is of so many independent flights;
    those of a seed are not, so it is rather too narrow.

    Args:
        scores: 0 or 1, float64 (seeds, arenas, flights) of one condition.
    """
    interval = bootstrap(mean, [scores])
    if not interval.is_given or float(np.ptp(scores)) > 0.0:
        return interval
    low, high = wilson_interval(float(scores.sum()), scores.size)
    return interval._replace(low=low, high=high, is_wilson=True)


def permutation_p(first: Floats, second: Floats) -> float:
    """Returns the two-sided p of the difference of the seeds' means under exchange of seeds; exact for few seeds.

    Takes cells (seeds, arenas). NaN with fewer than two seeds in either.
    """
    ours, theirs = first.mean(axis=1), second.mean(axis=1)
    if min(len(ours), len(theirs)) < 2:
        return float("nan")
    result = stats.permutation_test(
        (ours, theirs), lambda x, y: np.mean(x) - np.mean(y), n_resamples=20_000, rng=np.random.default_rng(0)
    )
    return float(result.pvalue)


def least_p(num_first: int, num_second: int) -> float:
    """Returns the smallest two-sided p that `permutation_p` can give with so many seeds."""
    return min(1.0, 2.0 / math.comb(num_first + num_second, num_first))


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p values corrected for their number by Holm's step-down method; NaN stays and does not count."""
    p = np.asarray(p_values, np.float64)
    corrected, given = np.full(len(p), np.nan), np.flatnonzero(np.isfinite(p))
    order = given[np.argsort(p[given], kind="stable")]
    steps = p[order] * (len(order) - np.arange(len(order)))
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(value) for value in corrected]


def _resample(scores: Floats, starts: NDArray[np.int64], generator: np.random.Generator) -> Floats:
    """Returns cells (resamples, seeds, arenas) of drawn seeds and of the flights from the drawn starts.

    `starts` is int64 (resamples, arenas, flights): numbers of flights.
    """
    num_seeds, num_arenas, _ = scores.shape
    seeds = generator.integers(num_seeds, size=(len(starts), num_seeds, 1, 1))
    return cells_of(scores[seeds, np.arange(num_arenas)[:, None], starts[:, None]])
