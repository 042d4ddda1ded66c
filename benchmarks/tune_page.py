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

The time from the start of `apex-bat train` to the first policy that completes 14 of 15 flights in simple, in the
condition memory, on {cores} cores, nothing else running. Each number is one training of {limit_s:g} s, whose policies
are written every {period_s:g} s and judged afterwards; where none completed 14, it is {limit_s:g} and as much again as
flights were missing. `*` marks what shipped until then. Made by `python -m benchmarks.tune --trials {trials}`, and then

    {command}

{outcome}

## Trained anew

What shipped, some changes of it, and the best trials, by turns, with seeds that no trial had.

"""
OUTCOME = """\
What came of it: a target network that is copied every 100 updates instead of every 500, and a learning rate of 0.0005
instead of 0.00025. A good policy needs some 700 updates so; until then the target would have been copied once. To
copy it every 50, and the smaller batches of the best trial, are not better by more than they vary. That one actor is
not worse than two on two cores was found by an earlier search (commit 33a405c), hence `actors = "auto"`."""
TRIALS = """
## Trials

Proposed by Optuna, the first {random} at random; each with another seed, so neighbours differ by chance, too. The best
first.

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
            command=content["command"],
            outcome=OUTCOME,
            trials=len(content["trials"]),
        )
        + _table(["median [s]", "of the seeds [s]", "", *names], anew)
        + TRIALS.format(random=content["num_random"])
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
