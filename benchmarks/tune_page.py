"""The page docs/results/tune.md, from the trials in docs/results/tune.json.

`python -m benchmarks.tune_page` makes it anew; a test holds it to the file.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

FILE = Path(__file__).resolve().parents[1] / "docs" / "results" / "tune.json"
HEAD = """# The search for settings

Made by `python -m benchmarks.tune` (see there) on {cores} cores, nothing else running: the time from the first
environment step until a policy completes 14 of 15 flights in simple, in the condition memory. The evaluator judges
every {period_s:g} s, so differences below that say nothing; a trial ends after {limit_s:g} s, and where 14 never came,
its value is that and as much again as flights were missing. `*` marks what shipped until then, the first trial.

What came of it: one actor flies as many steps as two where they share two cores with the learner, and each of the four
seeds reached 14 of 15 sooner with it. So the configurations for the bat have `actors = "auto"` now: the cores less two,
at least one. Nothing else that was found is better by more than it varies; it stayed as it was.

## Trained anew

The best trials and what ships, by turns, with seeds that no trial had; judged every {new_period_s:g} s.

"""
TRIALS = """
## Trials

Each with another seed; the best first.

"""


def page(content: Mapping[str, Any]) -> str:
    """Returns the page, Markdown."""
    shipped = content["shipped"]
    names = list(shipped)
    anew = [
        [f"**{statistics.median(one['values_s']):.0f}**", _brackets(one["values_s"]), *_cells(one["settings"], shipped)]
        for one in content["anew"]
        if one["values_s"]
    ]
    trials = sorted(content["trials"], key=lambda trial: trial["value_s"])
    rows = [[f"{one['value_s']:.0f}", f"{one['most']}", *_cells(one["settings"], shipped)] for one in trials]
    return (
        HEAD.format(
            cores=content["machine"]["cores"],
            period_s=content["period_s"],
            limit_s=content["limit_s"],
            new_period_s=content["new_period_s"],
        )
        + _table(["median [s]", "of the seeds [s]", "", *names], anew)
        + TRIALS
        + _table(["[s]", "flights completed, at most", "", *names], rows)
    )


def _cells(settings: Mapping[str, float], shipped: Mapping[str, float]) -> list[str]:
    return ["*" if settings == shipped else "", *(f"{settings[name]:.3g}" for name in shipped)]


def _brackets(values_s: Sequence[float]) -> str:
    return ", ".join(f"{value:.0f}" for value in values_s)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["--:"] * len(header), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


if __name__ == "__main__":
    FILE.with_suffix(".md").write_text(page(json.loads(FILE.read_text(encoding="utf-8"))), encoding="utf-8")
