"""The page docs/results/peers.md and its picture, made from docs/results/peers.json and peers_trials.json.

`python -m benchmarks.peers.report` makes them anew; a test holds the page to the files.
"""

from __future__ import annotations

import json
import math
import statistics
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.peers.contest import Result
from benchmarks.peers.terms import ENOUGH, ENVIRONMENTS, ROOT, Environment, entry_of
from benchmarks.peers.words import CAUSES, HEAD, SETTINGS, TRIALS

FILE = ROOT / "docs" / "results" / "peers.json"
OURS = "apex_bat"
GOALS: dict[Environment, float] = {"registered": 1.0 / 3.0, "obvious": 1.0 / 15.0}
"""At most this share of the best peer's time may apex_bat take; it always flies the registered environment itself."""
NEVER = math.inf
TRIALS_SUFFIX = "_trials"
"""Of the name of the file with trials."""


class Reached(NamedTuple):
    """When a training's policy first completed enough flights; infinite where none did."""

    wall_s: float
    env_steps: float
    updates: float
    cpu_s: float
    progress_m: float
    """Mean net way of its flights."""


class Group(NamedTuple):
    """All seeds of one entry in one environment."""

    entry: str
    environment: Environment
    results: list[Result]

    @property
    def label(self) -> str:
        """For tables and pictures."""
        return entry_of(self.entry).label

    @property
    def reached(self) -> list[Reached]:
        """Of each seed."""
        return [reached(result) for result in self.results]

    @property
    def budget_s(self) -> float:
        """Of each seed."""
        return float(self.results[0]["budget_s"])


def judged(result: Result) -> list[dict[str, Any]]:
    """Returns the points of a training's curve whose policies were judged."""
    return [point for point in result["curve"] if point["completed"] is not None]


def reached(result: Result) -> Reached:
    """Returns when a training first completed enough flights."""
    for point in judged(result):
        if point["completed"] >= ENOUGH:
            return Reached(*(float(point[name]) for name in Reached._fields))
    return Reached(*(NEVER for _ in Reached._fields))


def groups(results: Sequence[Result]) -> list[Group]:
    """Returns the results by environment and entry; seeds ascending."""
    found: dict[tuple[str, Environment], list[Result]] = {}
    for result in sorted(results, key=lambda each: int(each["seed"])):
        found.setdefault((result["entry"], result["environment"]), []).append(result)
    ordered = sorted(found, key=lambda key: ENVIRONMENTS.index(key[1]))
    return [Group(*key, found[key]) for key in ordered]


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Returns median and, in brackets, least and greatest; "never" stands for infinite."""
    numbers = [
        "never" if math.isinf(value) else f"{value:,.{digits}f}"
        for value in (statistics.median(values), min(values), max(values))
    ]
    return numbers[0] if len(values) == 1 else f"{numbers[0]} ({numbers[1]}, {numbers[2]})"


def best_peer(all_groups: Sequence[Group], environment: Environment) -> Group | None:
    """Returns the peer whose median time is least in an environment, the more seeds reached the better; None if none.

    Of peers that never got there in the median the one with the most seeds that did counts as the best.
    """
    peers = [group for group in all_groups if group.environment == environment and entry_of(group.entry).is_peer]

    def rank(group: Group) -> tuple[float, float]:
        walls_s = [each.wall_s for each in group.reached]
        return statistics.median(walls_s), sum(math.isinf(wall_s) for wall_s in walls_s) / len(walls_s)

    return min(peers, key=rank, default=None)


def goal(all_groups: Sequence[Group], environment: Environment) -> str:
    """Returns a sentence: apex_bat's time beside the best peer's, and by how much the goal is missed."""
    ours = next((group for group in all_groups if group.entry == OURS), None)
    best = best_peer(all_groups, environment)
    if ours is None or best is None:
        return f"In the {environment} environment nothing can be compared yet."
    limit = GOALS[environment]
    wanted = f"the goal is at most 1/{1.0 / limit:.0f}"
    own_s, peer_s = (statistics.median(each.wall_s for each in group.reached) for group in (ours, best))
    if math.isinf(own_s):
        return f"In the {environment} environment: apex_bat never reached {ENOUGH} of 15; {wanted}: missed."
    if math.isinf(peer_s):
        ratio = own_s / best.budget_s
        verdict = "met" if ratio <= limit else "not decided by this budget"
        return (
            f"In the {environment} environment no peer reached {ENOUGH} of 15 in {best.budget_s:.0f} s in the median; "
            f"apex_bat took {own_s:.0f} s, less than {ratio:.2f} of their time; {wanted}: {verdict}."
        )
    ratio = own_s / peer_s
    verdict = "met" if ratio <= limit else f"missed by a factor of {ratio / limit:.1f}"
    return (
        f"In the {environment} environment the best peer is {best.label} with {peer_s:.0f} s; apex_bat took "
        f"{own_s:.0f} s, {ratio:.2f} of that (1/{1.0 / ratio:.1f}); {wanted}: {verdict}."
    )


def table(all_groups: Sequence[Group], environment: Environment) -> list[str]:
    """Returns the table of an environment; apex_bat stands in each, though it only flies the registered one."""
    lines = [
        f"| | seeds | s to the first step | s to {ENOUGH} of 15 | steps to it | updates to it | CPU s to it "
        "| its progress in m | completed at the end | steps/s | updates/s | memory MB |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for group in all_groups:
        if group.environment != environment and group.entry != OURS:
            continue
        cells = [
            group.label + (" (registered environment)" if group.environment != environment else ""),
            str(len(group.results)),
            spread([float(result["start_s"]) for result in group.results]),
            *(spread([each[field] for each in group.reached]) for field in range(len(Reached._fields))),
            spread([float(judged(result)[-1]["completed"]) for result in group.results]),
            *(spread([float(result[name]) for result in group.results], digits) for name, digits in _RATES),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


_RATES = (("steps_per_s", 0), ("updates_per_s", 1), ("memory_mb", 0))


def summary(results: Sequence[Result]) -> str:
    """Returns the paragraph for the README."""
    all_groups = groups(results)
    return " ".join(goal(all_groups, environment) for environment in ENVIRONMENTS)


def document(content: dict[str, Any], trials: Sequence[Result]) -> str:
    """Returns the page, Markdown.

    Args:
        content: what the contest wrote.
        trials: results of shorter trainings by which the peers' settings were chosen.
    """
    results: list[Result] = content["results"]
    all_groups = groups(results)
    lines = [HEAD.format(every_s=_every(results)), ""]
    for environment in ENVIRONMENTS:
        budgets_s = sorted({group.budget_s for group in all_groups if group.environment == environment})
        if not budgets_s:
            lines += [f"## The {environment} environment", "", goal(all_groups, environment), ""]
            continue
        budget = " and ".join(f"{budget_s:.0f}" for budget_s in budgets_s)
        lines += [f"## The {environment} environment", "", f"{budget} s each. {goal(all_groups, environment)}", ""]
        lines += [*table(all_groups, environment), ""]
    lines += ["![Completed flights over time](peers.png)", "", "*Median over the seeds; the shade is from least to "
              "greatest.*", "", CAUSES, "## Who took part", "", *_parties(all_groups), ""]  # fmt: skip
    lines += [_settings(content["terms"]), "## What was tried", "", *_trials(trials)]
    lines += ["", "## Where and with what", ""]
    return "\n".join([*lines, *_circumstances(content)]) + "\n"


def write(file: Path = FILE) -> Path:
    """Writes page and picture beside a file of results; returns the page's path."""
    from benchmarks.peers.figure import draw

    content = json.loads(file.read_text(encoding="utf-8"))
    page = file.with_suffix(".md")
    page.write_text(document(content, load_trials(file)), encoding="utf-8")
    draw(groups(content["results"]), file.with_suffix(".png"))
    return page


def load_trials(file: Path) -> list[Result]:
    """Returns the trials that lie beside a file of results."""
    path = file.with_name(f"{file.stem}{TRIALS_SUFFIX}.json")
    if not path.exists():
        return []
    trials: list[Result] = json.loads(path.read_text(encoding="utf-8"))["results"]
    return trials


def _parties(all_groups: Sequence[Group]) -> list[str]:
    lines = ["| | what | versions |", "|---|---|---|"]
    for name in dict.fromkeys(group.entry for group in all_groups):
        entry = entry_of(name)
        versions = next(group.results[0]["versions"] for group in all_groups if group.entry == name)
        noted = ", ".join(f"{package} {version}" for package, version in versions.items())
        lines.append(f"| {entry.label} | {entry.what} | {noted} |")
    return lines


def _settings(shared: Mapping[str, Any]) -> str:
    learner, replay = shared["learner"], shared["replay"]
    steps = learner["batch_size"] / replay["samples_per_insert"]
    title, sentence, *rest = SETTINGS.format(learner=learner, replay=replay, steps=steps).split("\n\n")
    return "\n\n".join([title, textwrap.fill(sentence, 118, break_long_words=False, break_on_hyphens=False), *rest])


def _trials(trials: Sequence[Result]) -> list[str]:
    if not trials:
        return ["No trials are kept."]
    lines = [
        TRIALS,
        f"| | environment | settings | seed | s | steps | s to {ENOUGH} of 15 | steps to it | most completed "
        "| steps/s | updates/s |",
        "|---|---|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for result in sorted(trials, key=lambda each: (each["entry"], each["environment"], each["overrides"])):
        wall_s, steps, *_ = reached(result)
        cells = (
            entry_of(result["entry"]).label, result["environment"],
            ", ".join(f"`{text}`" for text in result["overrides"]) or "as chosen", str(result["seed"]),
            f"{result['budget_s']:.0f}", f"{result['curve'][-1]['env_steps']:,}", spread([wall_s]), spread([steps]),
            str(max(point["completed"] for point in judged(result))), f"{result['steps_per_s']:.0f}",
            f"{result['updates_per_s']:.1f}",
        )  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _circumstances(content: dict[str, Any]) -> list[str]:
    results, machine = content["results"], content["machine"]
    commits = ", ".join(sorted({str(result["commit"])[:12] for result in results}))
    days = sorted({str(result["ended"])[:10] for result in results})
    return [
        f"{machine['cores']} cores of {machine['processor']}, no GPU, Python {machine['python']}; "
        f"{' and '.join(dict.fromkeys((days[0], days[-1])))}; commit {commits}. The command, after `make peers`:",
        "",
        "```",
        _command(results),
        "```",
        "",
        "Every figure of every seed is in `peers.json`. So few seeds say little: their least and greatest are all that "
        "can be said of the spread.",
    ]


def _every(results: Sequence[Result]) -> str:
    return " or ".join(f"{every_s:g}" for every_s in sorted({float(result["every_s"]) for result in results}))


def _command(results: Sequence[Result]) -> str:
    seeds = 1 + max(int(result["seed"]) for result in results)
    budgets = {str(result["environment"]): float(result["budget_s"]) for result in results}
    registered, every_s = budgets.get("registered", 0.0), float(results[0]["every_s"])
    text = f"python -m benchmarks.peers --budget-s {registered:g} --seeds {seeds} --every-s {every_s:g}"
    text += " --json docs/results/peers.json"
    obvious = budgets.get("obvious", registered)
    return text if obvious == registered else f"{text} --obvious-budget-s {obvious:g}"


if __name__ == "__main__":
    write()
