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
from apex_bat.evaluation.results import ARENAS, Protocol

Verdict = Literal["reproduced", "not reproduced", "not comparable"]

NUM_FLIGHTS, NUM_STEPS = 15, 1000
"""Flights in each arena, and their longest, of the thesis."""
COMPLETED = {"memory": 1.00, "no_memory": 0.66, "onset": 0.21}
DISTANCE_RATIOS = {("memory", "no_memory"): 1.5, ("memory", "onset"): 6.0}
Z_TESTS = {("memory", "no_memory"): (2.4, 0.05), ("no_memory", "onset"): (2.5, 0.01)}
"""Least z of the completed flights, and greatest p."""
H_STEPS, H_STRAIGHT, P_KRUSKAL = 16.0, 22.0, 0.01
RATIO_BAND = 0.2
"""How far a ratio may be from the thesis's, as a share of it: the thesis rounds 1.5 and 6 and gives no spread."""
WIDEST_SHARE, WIDEST_RATIO = 0.4, 0.8
"""Widest interval of a share, and of a ratio as a share of the thesis's, with which a number can be reproduced."""
WEAK_MARK = "\u2020"
"""Follows an interval from too few seeds: a dagger."""
MOST_UNEQUAL_STEPS = 1.05
"""Conditions whose training lengths differ by a greater factor are not compared."""

RULES = (
    f"The thesis's completed shares stem from {NUM_FLIGHTS * len(ARENAS)} flights each; their band is Wilson's 95 % "
    f"interval for so many. The band of a ratio is the thesis's number +- {100 * RATIO_BAND:.0f} %, which is our "
    "choice: the thesis gives no spread.",
    "A share or ratio is reproduced when our estimate lies in the band and our 95 % interval is no wider than "
    f"{100 * WIDEST_SHARE:.0f} points (a ratio: {100 * WIDEST_RATIO:.0f} % of the thesis's); not reproduced when our "
    "whole interval lies outside the band; otherwise not comparable, because these runs cannot tell.",
    "A test is made for each seed, as a repetition of the thesis's experiment with its flights as the unit. It is "
    "reproduced when it comes out as the thesis reports (the statistic beyond its bound, in its direction, and p below "
    "its bound) for at least two thirds of the seeds; not reproduced when for fewer than one third; otherwise not "
    "comparable, because it depends on the seed. A test that cannot be made, because all flights ended alike, "
    "did not come out so. The thesis's z-tests are read as holding in each arena.",
    f"Nothing is comparable with fewer than {statistics.ENOUGH_SEEDS} seeds of a condition, with other flights than "
    f"the thesis's ({NUM_FLIGHTS} of at most {NUM_STEPS} steps in each of {', '.join(ARENAS)}), or when the conditions "
    f"were trained for numbers of steps that differ by more than a factor of {MOST_UNEQUAL_STEPS}.",
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


def obstacle(names: Sequence[str], groups: Mapping[str, Group], protocol: Protocol) -> str:
    """Returns why these conditions cannot be compared with the thesis; empty if they can."""
    missing = [name for name in names if name not in groups]
    if missing:
        return f"{' and '.join(missing)} not trained"
    longest = max(run.config.episode.evaluation_steps for name in names for run in groups[name].runs)
    if (tuple(protocol.arenas), protocol.num_flights, longest) != (ARENAS, NUM_FLIGHTS, NUM_STEPS):
        return "other flights than the thesis's"
    few = [f"{name} {groups[name].num_seeds}" for name in names if groups[name].num_seeds < statistics.ENOUGH_SEEDS]
    if few:
        return f"fewer than {statistics.ENOUGH_SEEDS} seeds ({', '.join(few)})"
    trained = [run.facts.get("env_steps") or 0 for name in names for run in groups[name].runs]
    if min(trained) * MOST_UNEQUAL_STEPS < max(trained):
        return f"trained for {min(trained):,} to {max(trained):,} steps"
    return ""


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
    interval = statistics.bootstrap(statistics.mean, [groups[name].scores(protocol.arenas, completed)])
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
    scores = [groups[name].scores([arena], value)[:, 0] for name in COMPLETED]
    tests = [statistics.kruskal_wallis(list(seed)) for seed in zip(*scores, strict=False)]
    num_so = sum(test.statistic > least and test.p < P_KRUSKAL for test in tests)
    verdict, reason = judge_seeds(num_so, len(tests))
    return _finding(claim, thesis, _shown_tests("H", tests), verdict, reason, hindrance)


def _proportions(
    pair: tuple[str, str], bounds: tuple[float, float], arena: str, groups: Mapping[str, Group], protocol: Protocol
) -> Finding:
    least, greatest_p = bounds
    claim, thesis = (
        f"z-test of completed flights, {pair[0]} v. {pair[1]}, {arena}",
        f"z > {least:g}, p < {greatest_p:g}",
    )
    hindrance = obstacle(pair, groups, protocol)
    if any(name not in groups for name in pair) or arena not in protocol.arenas:
        return Finding(claim, thesis, "-", "not comparable", hindrance)
    ours, theirs = (groups[name].scores([arena], completed)[:, 0] for name in pair)
    tests = [
        statistics.proportions_z(int(a.sum()), len(a), int(b.sum()), len(b)) for a, b in zip(ours, theirs, strict=False)
    ]
    num_so = sum(test.statistic > least and test.p < greatest_p for test in tests)
    verdict, reason = judge_seeds(num_so, len(tests))
    return _finding(claim, thesis, _shown_tests("z", tests), verdict, reason, hindrance)


def shown(interval: statistics.Interval, scale: float, unit: str, decimals: int = 0) -> str:
    """Returns an estimate with its interval, marked where there are too few seeds for one."""
    text = f"{scale * interval.estimate:.{decimals}f}{unit}"
    if not interval.is_given:
        return text
    mark = WEAK_MARK if interval.is_weak else ""
    return f"{text} [{scale * interval.low:.{decimals}f}, {scale * interval.high:.{decimals}f}]{mark}"


def shown_p(p: float) -> str:
    """Returns a p value as text."""
    return "-" if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def _shown_tests(symbol: str, tests: Sequence[statistics.Test]) -> str:
    if all(math.isnan(test.statistic) for test in tests):
        return "no test possible: all flights ended alike"
    values = ", ".join("-" if math.isnan(test.statistic) else f"{test.statistic:.1f}" for test in tests)
    greatest = max((test.p for test in tests if not math.isnan(test.p)), default=math.nan)
    return f"{symbol} = {values}; p {'' if len(tests) == 1 else 'at most '}{shown_p(greatest)}"


def _finding(claim: str, thesis: str, ours: str, verdict: Verdict, reason: str, hindrance: str) -> Finding:
    if hindrance:
        return Finding(claim, thesis, ours, "not comparable", hindrance)
    return Finding(claim, thesis, ours, verdict, reason)
