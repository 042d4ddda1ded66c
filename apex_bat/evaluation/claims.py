"""What the thesis found (Mohan & Vanderelst 2020, ch. 4), number by number, and whether these runs find it too.

The rules of the verdicts stand in `RULES`, which every report prints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

from apex_bat.evaluation import statistics
from apex_bat.evaluation.flights import FlightRecord
from apex_bat.evaluation.groups import Group
from apex_bat.evaluation.obstacles import MOST_UNEQUAL_TRAINING, NUM_FLIGHTS, NUM_STEPS, obstacle
from apex_bat.evaluation.results import ARENAS, Protocol

Verdict = Literal["reproduced", "not reproduced", "not comparable"]

COMPLETED = {"memory": 1.00, "no_memory": 0.66, "onset": 0.21}
DISTANCE_RATIOS = {("memory", "no_memory"): 1.5, ("memory", "onset"): 6.0}
Z_TESTS = {("memory", "no_memory"): (2.4, 0.05), ("no_memory", "onset"): (2.5, 0.01)}
"""Least z of the completed flights that the thesis found, and its bound of p."""
H_STEPS, H_STRAIGHT, P_KRUSKAL = 16.0, 22.0, 0.01
RATIO_BAND = 0.2
"""How far a ratio may be from the thesis's, as a share of it: the thesis rounds 1.5 and 6 and gives no spread."""
WIDEST_SHARE, WIDEST_RATIO = 0.4, 0.8
"""Widest interval of a share, and of a ratio as a share of the thesis's, with which a number can be reproduced."""
WEAK_MARK, ALIKE_MARK = "\u2020", "\u2021"
"""Follow an interval from too few seeds (a dagger), and one whose resamples are all alike (a double dagger)."""

_ALL = NUM_FLIGHTS * len(ARENAS)
RULES = (
    "Held against the thesis are the runs of the default settings; where there are none, those of the only settings "
    "there are, if arena, body, rays, sonar, sensing and episode are the thesis's.",
    f"The thesis's completed shares are taken to stem from {_ALL} flights each, though 21 % is no number of {_ALL} "
    f"flights (9 are 20 %, 10 are 22 %); their band is Wilson's 95 % interval for so many. The band of a ratio is the "
    f"thesis's number +- {100 * RATIO_BAND:.0f} %, which is our choice: the thesis gives no spread.",
    "That memory flies 6 times as far as onset contradicts the thesis's own shares: no flight is longer than "
    f"{NUM_STEPS} steps (150 m), so that with 21 % of onset's flights completed the ratio is at most "
    f"{1 / COMPLETED['onset']:.1f}. It is not comparable, whatever these runs give.",
    "A share or ratio is reproduced when our estimate lies in the band and our 95 % interval is no wider than "
    f"{100 * WIDEST_SHARE:.0f} points (a ratio: {100 * WIDEST_RATIO:.0f} % of the thesis's); not reproduced when our "
    "whole interval lies outside the band; otherwise not comparable, because these runs cannot tell.",
    "A test is made for each seed from which all its conditions were trained, as a repetition of the thesis's "
    "experiment with its flights as the unit; of a seed trained more than once the first run by name counts. It is "
    "reproduced when it comes out as the thesis reports for at least two thirds of the seeds; not reproduced when for "
    "fewer than one third; otherwise not comparable, because it depends on the seed. A test that cannot be made, "
    "because all flights ended alike, did not come out so.",
    "A z-test comes out as the thesis's when z is positive (two-sided) and p below the thesis's bound: its z > 2.4 and "
    "z > 2.5 tell what it found, and to ask for as much of a repetition would fail most true ones. They are read as "
    "holding in each arena.",
    f"A Kruskal-Wallis test comes out as the thesis's when H and p are beyond its bounds and the means of the "
    "conditions fall from memory over no_memory to onset. For the share of straight actions the thesis's order is "
    f"taken to be this too. H > {H_STEPS:g} and H > {H_STRAIGHT:g} are read as holding in each arena.",
    f"Nothing is comparable with fewer than {statistics.ENOUGH_SEEDS} seeds of a condition, with other flights than "
    f"the thesis's ({NUM_FLIGHTS} of at most {NUM_STEPS} steps in each of {', '.join(ARENAS)}), with a training that "
    "did not reach its end or whose length is unknown, or when environment steps or updates of the trainings differ "
    f"by more than a factor of {MOST_UNEQUAL_TRAINING}.",
)


class Finding(NamedTuple):
    """A number of the thesis beside ours."""

    claim: str
    thesis: str
    ours: str
    verdict: Verdict
    reason: str


def completed(record: FlightRecord) -> float:
    """Returns 1 for a flight that reached the time limit, else 0."""
    return float(record.completed)


def steps(record: FlightRecord) -> float:
    """Returns the steps of a flight."""
    return float(record.steps)


def distance_m(record: FlightRecord) -> float:
    """Returns the way flown."""
    return record.distance_m


def progress_m(record: FlightRecord) -> float:
    """Returns the net way along the corridor."""
    return record.progress_m


def straight_share(record: FlightRecord) -> float:
    """Returns the share of straight actions."""
    return record.action_shares[0]


def findings(groups: Mapping[str, Group], protocol: Protocol) -> list[Finding]:
    """Returns every number of the thesis with ours and a verdict.

    Args:
        groups: by condition; those that were not trained are missing.
        protocol: how the flights were made.
    """
    rows = [_share(name, share, groups, protocol) for name, share in COMPLETED.items()]
    rows += [_ratio(pair, value, groups, protocol) for pair, value in DISTANCE_RATIOS.items()]
    for arena in ARENAS:
        rows.append(_kruskal("completed steps", steps, H_STEPS, arena, groups, protocol))
    for arena in ARENAS:
        rows.append(_kruskal("share of straight actions", straight_share, H_STRAIGHT, arena, groups, protocol))
    for pair, bounds in Z_TESTS.items():
        rows += [_proportions(pair, bounds, arena, groups, protocol) for arena in ARENAS]
    return rows


def judge_number(
    interval: statistics.Interval, thesis: float, band: tuple[float, float], widest: float
) -> tuple[Verdict, str]:
    """Returns the verdict on a number by the rules above, and why."""
    low, high = band
    if not interval.is_given:
        return "not comparable", "no interval"
    if interval.low > high or interval.high < low:
        side = "above" if interval.low > high else "below"
        return "not reproduced", f"our interval lies {side} the thesis's band {low:.2f} to {high:.2f}"
    if not low <= interval.estimate <= high:
        return "not comparable", f"outside the thesis's band {low:.2f} to {high:.2f}, but the interval reaches into it"
    if interval.high - interval.low > widest:
        return "not comparable", f"near {thesis:g}, but the interval is too wide to say so"
    return "reproduced", f"in the thesis's band {low:.2f} to {high:.2f}"


def judge_seeds(num_so: int, num_seeds: int) -> tuple[Verdict, str]:
    """Returns the verdict on a test that came out as the thesis's for some of the seeds, and why."""
    reason = f"for {num_so} of {num_seeds} seeds"
    if 3 * num_so >= 2 * num_seeds:
        return "reproduced", reason
    return ("not reproduced", reason) if 3 * num_so < num_seeds else ("not comparable", f"{reason}: it depends on them")


def _share(name: str, share: float, groups: Mapping[str, Group], protocol: Protocol) -> Finding:
    band = statistics.wilson_interval(share * NUM_FLIGHTS * len(ARENAS), NUM_FLIGHTS * len(ARENAS))
    claim = f"flights completed, {name}"
    if name not in groups:
        return Finding(claim, f"{100 * share:.0f} %", "-", "not comparable", obstacle([name], groups, protocol))
    interval = statistics.bootstrap_share(groups[name].scores(protocol.arenas, completed))
    hindrance = obstacle([name], groups, protocol)
    verdict, reason = judge_number(interval, share, band, WIDEST_SHARE)
    ours = shown(interval, 100.0, " %")
    return _finding(claim, f"{100 * share:.0f} %", ours, verdict, reason, hindrance)


def _ratio(pair: tuple[str, str], value: float, groups: Mapping[str, Group], protocol: Protocol) -> Finding:
    claim, hindrance = f"distance flown, {pair[0]} / {pair[1]}", obstacle(pair, groups, protocol)
    if any(name not in groups for name in pair):
        return Finding(claim, f"{value:g}", "-", "not comparable", hindrance)
    scores = [groups[name].scores(protocol.arenas, distance_m) for name in pair]
    interval = statistics.bootstrap(statistics.ratio, scores)
    greatest = 1.0 / COMPLETED[pair[1]]  # the first flies no farther than the cap, the second that far so often
    if value > greatest:
        own = f"{100 * COMPLETED[pair[1]]:.0f} % of flights completed by {pair[1]}"
        hindrance = f"the thesis contradicts itself: with {own} the ratio is at most {greatest:.1f}"
    band = (value * (1 - RATIO_BAND), value * (1 + RATIO_BAND))
    verdict, reason = judge_number(interval, value, band, WIDEST_RATIO * value)
    return _finding(claim, f"{value:g}", shown(interval, 1.0, "", 2), verdict, reason, hindrance)


def _kruskal(
    what: str,
    value: Callable[[FlightRecord], float],
    least: float,
    arena: str,
    groups: Mapping[str, Group],
    protocol: Protocol,
) -> Finding:
    claim, thesis = f"Kruskal-Wallis on {what}, {arena}", f"H > {least:g}, p < {P_KRUSKAL:g}"
    hindrance = obstacle(list(COMPLETED), groups, protocol)
    if any(name not in groups for name in COMPLETED) or arena not in protocol.arenas:
        return Finding(claim, thesis, "-", "not comparable", hindrance)
    shared = _shared_seeds(list(COMPLETED), groups)
    tests, num_so = [], 0
    for seed in shared.seeds:
        samples = [groups[name].first_of(seed).scores([arena], value)[0] for name in COMPLETED]
        test = statistics.kruskal_wallis(samples)
        means = [sample.mean() for sample in samples]
        num_so += test.statistic > least and test.p < P_KRUSKAL and means[0] > means[1] > means[2]
        tests.append(test)
    verdict, reason = judge_seeds(num_so, len(tests))
    return _finding(
        claim, thesis, _shown_tests("H", tests), verdict, reason + shared.remark, hindrance or shared.hindrance
    )


def _proportions(
    pair: tuple[str, str], bounds: tuple[float, float], arena: str, groups: Mapping[str, Group], protocol: Protocol
) -> Finding:
    claim, thesis = (
        f"z-test of completed flights, {pair[0]} v. {pair[1]}, {arena}",
        f"z > {bounds[0]:g}, p < {bounds[1]:g}",
    )
    hindrance = obstacle(pair, groups, protocol)
    if any(name not in groups for name in pair) or arena not in protocol.arenas:
        return Finding(claim, thesis, "-", "not comparable", hindrance)
    shared = _shared_seeds(pair, groups)
    tests = []
    for seed in shared.seeds:
        ours, theirs = (groups[name].first_of(seed).scores([arena], completed)[0] for name in pair)
        tests.append(statistics.proportions_z(int(ours.sum()), len(ours), int(theirs.sum()), len(theirs)))
    num_so = sum(test.statistic > 0.0 and test.p < bounds[1] for test in tests)
    verdict, reason = judge_seeds(num_so, len(tests))
    return _finding(
        claim, thesis, _shown_tests("z", tests), verdict, reason + shared.remark, hindrance or shared.hindrance
    )


def shown(interval: statistics.Interval, scale: float, unit: str, decimals: int = 0) -> str:
    """Returns an estimate with its interval, marked where there are too few seeds or all resamples are alike."""
    text = f"{scale * interval.estimate:.{decimals}f}{unit}"
    if not interval.is_given:
        return text
    mark = (WEAK_MARK if interval.is_weak else "") + (ALIKE_MARK if interval.is_alike else "")
    return f"{text} [{scale * interval.low:.{decimals}f}, {scale * interval.high:.{decimals}f}]{mark}"


def shown_p(p: float) -> str:
    """Returns a p value as text."""
    return "-" if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}"


class _SharedSeeds(NamedTuple):
    """The seeds from which several conditions were trained, by which their tests are paired."""

    seeds: list[int]
    remark: str
    """Which seeds have no partner; empty if all have."""
    hindrance: str
    """Why these seeds do not suffice; empty if they do."""


def _shared_seeds(names: Sequence[str], groups: Mapping[str, Group]) -> _SharedSeeds:
    seeds = sorted(set.intersection(*(set(groups[name].seeds) for name in names)))
    alone = {name: [str(seed) for seed in groups[name].seeds if seed not in seeds] for name in names}
    words = [f"{name} {', '.join(left)}" for name, left in alone.items() if left]
    remark = f"; seeds without a partner: {'; '.join(words)}" if words else ""
    few = f"fewer than {statistics.ENOUGH_SEEDS} seeds that {', '.join(names)} share{remark}"
    return _SharedSeeds(seeds, remark, few if len(seeds) < statistics.ENOUGH_SEEDS else "")


def _shown_tests(symbol: str, tests: Sequence[statistics.Test]) -> str:
    if not tests:
        return "-"
    if all(math.isnan(test.statistic) for test in tests):
        return "no test possible: all flights ended alike"
    decimals = 2 if symbol == "z" else 1
    values = ", ".join("-" if math.isnan(test.statistic) else f"{test.statistic:.{decimals}f}" for test in tests)
    greatest = shown_p(max(test.p for test in tests if not math.isnan(test.p)))
    is_bound = len(tests) == 1 or greatest.startswith("<")
    return f"{symbol} = {values}; p {'' if is_bound else 'at most '}{greatest}"


def _finding(claim: str, thesis: str, ours: str, verdict: Verdict, reason: str, hindrance: str) -> Finding:
    if hindrance:
        return Finding(claim, thesis, ours, "not comparable", hindrance)
    return Finding(claim, thesis, ours, verdict, reason)
