"""The tables of a report: how each condition and baseline flew, how conditions compare, which runs there are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from apex_bat.evaluation import statistics
from apex_bat.evaluation.baselines import BASELINES
from apex_bat.evaluation.claims import Finding, completed, distance_m, progress_m, shown, shown_p, steps, straight_share
from apex_bat.evaluation.document import Table
from apex_bat.evaluation.flights import FlightRecord
from apex_bat.evaluation.groups import Group
from apex_bat.evaluation.obstacles import unequal_training
from apex_bat.evaluation.results import Protocol

Value = Callable[[FlightRecord], float]

COMPARED: tuple[tuple[str, Value, float, str], ...] = (
    ("flights completed", completed, 100.0, " points"),
    ("distance flown", distance_m, 1.0, " m"),
)
"""What conditions are compared by: name, value of a flight, scale and unit of the difference."""


class Comparison(NamedTuple):
    """Two groups compared by one value; both trained, or the second a baseline."""

    what: str
    first: str
    second: str
    difference: statistics.Interval
    improvement: statistics.Interval
    """Probability that a seed of the first is better than one of the second."""
    effect: float
    """Hedges' g; NaN against a baseline."""
    p: float
    """Of the permutation of seeds; NaN against a baseline, which has none."""
    corrected_p: float
    """The same by Holm, over all comparisons of trained groups in the report."""
    remark: str = ""
    """How far the two were not trained alike long."""


def findings_table(findings: Sequence[Finding]) -> Table:
    """Returns each number of the thesis beside ours, with the verdict."""
    rows = [(each.claim, each.thesis, each.ours, each.verdict, each.reason) for each in findings]
    return Table(("number", "thesis", "these runs", "verdict", "why"), rows, num_left=5)


def arena_table(groups: Sequence[Group], protocol: Protocol) -> Table:
    """Returns how each group flew in each arena."""
    columns = (
        "arena", "pilot", "seeds", "completed (%)", "steps", "distance (m)", "progress (m)", "straight (%)",
        "to the wall (m)",
    )  # fmt: skip
    rows = []
    for arena in protocol.arenas:
        for each in groups:
            means = [_mean_of(each, [arena], value) for value in (steps, distance_m, progress_m, straight_share)]
            near = np.median(
                [record.clearance_quantiles_m[3] for run in each.runs for record, _ in run.of_arena(arena)]
            )
            share = _share(each, [arena])
            cells = (f"{means[0]:.0f}", f"{means[1]:.1f}", f"{means[2]:.1f}", f"{100 * means[3]:.0f}", f"{near:.2f}")
            rows.append((arena, each.label, _seeds(each), share, *cells))
    caption = (
        "Means over seeds and flights; in brackets 95 % intervals over seeds where there are two or more. Progress is "
        "the net way along the corridor, which a bat that circles on the spot does not make. To the wall: the median "
        "over all flights of each flight's median."
    )
    return Table(columns, rows, caption, num_left=2)


def overall_table(groups: Sequence[Group], protocol: Protocol) -> Table:
    """Returns how each group flew in all arenas together."""
    columns = ("pilot", "seeds", "completed (%)", "the same, IQM", "distance (m)", "the same, IQM", "progress (m)")
    rows = []
    for each in groups:
        arenas = protocol.arenas
        has_middle = each.num_seeds * len(arenas) >= statistics.LEAST_FOR_IQM
        middles = [
            _estimate(each, arenas, value, scale, decimals, statistics.interquartile_mean) if has_middle else "-"
            for value, scale, decimals in ((completed, 100.0, 0), (distance_m, 1.0, 1))
        ]
        distance, progress = (_estimate(each, arenas, value, 1.0, 1) for value in (distance_m, progress_m))
        rows.append((each.label, _seeds(each), _share(each, arenas), middles[0], distance, middles[1], progress))
    caption = (
        f"All of {', '.join(protocol.arenas)}. IQM: interquartile mean, the mean of the middle half of the values of "
        f"all seeds and arenas; not given of fewer than {statistics.LEAST_FOR_IQM}, of which it would leave none out."
    )
    return Table(columns, rows, caption)


def compare(groups: Sequence[Group], protocol: Protocol) -> list[Comparison]:
    """Returns the comparisons of all pairs of trained groups, and of each trained group with each baseline."""
    trained = [each for each in groups if each.is_trained]
    baselines = [each for each in groups if not each.is_trained]
    found = []
    for what, value, _, _ in COMPARED:
        pairs = list(combinations(trained, 2))
        p_values = [
            statistics.permutation_p(*(statistics.cells_of(each.scores(protocol.arenas, value)) for each in pair))
            for pair in pairs
        ]
        found += [_compare(what, value, *pair, protocol, p) for pair, p in zip(pairs, p_values, strict=True)]
        found += [_compare(what, value, one, other, protocol, math.nan) for one in trained for other in baselines]
    corrected = statistics.holm([each.p for each in found])
    return [each._replace(corrected_p=p) for each, p in zip(found, corrected, strict=True)]


def comparison_table(comparisons: Sequence[Comparison]) -> Table:
    """Returns the comparisons of trained groups as a table."""
    columns = (
        "value", "first", "second", "first less second", "P(first better)", "Hedges' g", "p", "p, Holm", "training",
    )  # fmt: skip
    comparisons = [each for each in comparisons if each.second not in BASELINES]
    rows = [
        (
            *_words(each), "-" if math.isnan(each.effect) else f"{each.effect:.2f}", shown_p(each.p),
            shown_p(each.corrected_p), each.remark or "alike long",
        )
        for each in comparisons
    ]  # fmt: skip
    num_tests = sum(not math.isnan(each.p) for each in comparisons)
    tests = (
        f"p: permutation of seeds, two-sided; corrected for {num_tests} tests."
        if num_tests
        else "No tests: they need two seeds of both."
    )
    caption = (
        f"All arenas together. {tests} Hedges' g: the difference in standard deviations between seeds. P(first "
        "better): probability of improvement."
    )
    return Table(columns, rows, caption, num_left=3)


def baseline_table(comparisons: Sequence[Comparison]) -> Table:
    """Returns the comparisons of trained groups with baselines as a table."""
    rows = [_words(each) for each in comparisons if each.second in BASELINES]
    caption = "All arenas together. A baseline has no seeds: it is compared by its flights alone, without a test."
    return Table(("value", "first", "second", "first less second", "P(first better)"), rows, caption, num_left=3)


def runs_table(groups: Sequence[Group]) -> Table:
    """Returns the facts of each run."""
    columns = (
        "run", "condition", "seed", "env steps", "updates", "samples per insert", "checkpoints judged", "best update",
        "minutes", "begun", "outcome", "commit", "machine",
    )  # fmt: skip
    rows = [
        _facts_row(run.name, each.label, run.facts, run.num_judged)
        for each in groups
        if each.is_trained
        for run in each.runs
    ]
    caption = (
        "Checkpoints judged: how many flew during training, of which the best flew here; where none did, the newest."
    )
    return Table(columns, rows, caption, num_left=2)


def _facts_row(name: str, label: str, facts: dict[str, Any], num_judged: int) -> tuple[str, ...]:
    ratio, wall_s = facts.get("samples_per_insert"), facts.get("wall_s")
    commit, begun = facts.get("commit"), str(facts.get("start") or "-")
    machine = " ".join(str(part) for part in (facts.get("host"), facts.get("platform")) if part)
    outcome = f"{facts.get('outcome') or '-'}{', resumed' if facts.get('resumed') else ''}"
    return (
        name, label, str(facts.get("seed")), _count(facts.get("env_steps")), _count(facts.get("learner_steps")),
        "-" if ratio is None else f"{ratio:.2f}", str(num_judged), _count(facts.get("checkpoint_step")),
        "-" if wall_s is None else f"{wall_s / 60.0:.1f}", begun[:16].replace("T", " "), outcome,
        commit[:10] + ("+" if commit.endswith("+") else "") if commit else "-", machine or "-",
    )  # fmt: skip


def _count(number: int | None) -> str:
    return "-" if number is None else f"{number:,}"


def _words(each: Comparison) -> tuple[str, ...]:
    scale, unit = next((scale, unit) for what, _, scale, unit in COMPARED if what == each.what)
    difference = shown(each.difference, scale, unit, decimals=1)
    return each.what, each.first, each.second, difference, shown(each.improvement, 1.0, "", 2)


def _compare(what: str, value: Value, first: Group, second: Group, protocol: Protocol, p: float) -> Comparison:
    ours, theirs = (each.scores(protocol.arenas, value) for each in (first, second))
    split = ([ours, theirs],) if second.is_trained else ([ours], [theirs])
    effect = statistics.hedges_g(statistics.cells_of(ours), statistics.cells_of(theirs))
    return Comparison(
        what, first.label, second.label, statistics.bootstrap(statistics.difference, *split),
        statistics.bootstrap(statistics.probability_of_improvement, *split), effect, p, math.nan,
        unequal_training([*first.runs, *second.runs]) if second.is_trained else "",
    )  # fmt: skip


def _mean_of(each: Group, arenas: Sequence[str], value: Value) -> float:
    return float(statistics.mean(statistics.cells_of(each.scores(arenas, value))))


def _estimate(
    each: Group,
    arenas: Sequence[str],
    value: Value,
    scale: float,
    decimals: int = 0,
    statistic: statistics.Statistic = statistics.mean,
) -> str:
    return shown(statistics.bootstrap(statistic, [each.scores(arenas, value)]), scale, "", decimals)


def _share(each: Group, arenas: Sequence[str]) -> str:
    return shown(statistics.bootstrap_share(each.scores(arenas, completed)), 100.0, "")


def _seeds(each: Group) -> str:
    return str(each.num_seeds) if each.is_trained else "-"
