"""The page of measured figures beside their targets, `docs/performance.md`, made from `docs/results/bench_*.json`.

Run `apex-bat bench PART --json docs/results/bench_PART.json` for the parts that are to be renewed, then
`python -m benchmarks.performance > docs/performance.md`; a test holds the page to the files.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results"
PARTS = ("simulation", "replay", "snapshot", "wire", "learner", "system", "recording")


class Target(NamedTuple):
    """What a figure should reach."""

    what: str
    name: str
    """Of the record."""
    limit: float
    is_least: bool
    """Whether more than the limit is good; else less is."""


def _replay_targets() -> list[Target]:
    limits = {"insert_50": (40, 60), "sample_512": (330, 450), "update_512": (50, 100)}
    words = {"insert_50": "insert 50 transitions", "sample_512": "sample 512", "update_512": "update 512 priorities"}
    return [
        Target(f"{words[name]}, {capacity:,} held [us of CPU]", f"replay.{name}.cap_{capacity}.cpu_us", limit, False)
        for name, pair in limits.items()
        for capacity, limit in zip((50_000, 1_000_000), pair, strict=True)
    ]


TARGETS: tuple[Target, ...] = (
    Target("16 bats on one core [steps/s]", "simulation.sixteen.steps_per_s", 2_000, True),
    Target("the same, times the obvious way", "simulation.ratio", 20, True),
    *_replay_targets(),
    Target("sample 512 of 1,000,000, in cpprb's time", "replay.sample_512.cap_1000000.ratio_to_cpprb", 0.75, False),
    Target("memory of 1,000,000 transitions [MB]", "replay.resident_mb.cap_1000000", 600, False),
    Target("longest turn of a server while it writes a snapshot of them [ms]", "snapshot.longest_turn_ms", 100, False),
    Target("server saturated by 4 actors and a learner: inserted/s", "wire.server.inserted_per_s", 100_000, True),
    Target("batches of 512 a second from the same server meanwhile", "wire.server.batches_512_per_s", 500, True),
    Target("insert of 50, acknowledged, 99th percentile [ms]", "wire.insert_50.p99_ms", 2, False),
    Target("weights, 250,000 parameters, at the last of 8 actors [ms]", "wire.weights_8.max_ms", 100, False),
    Target("learner on the real server, in rates of in-memory batches", "learner.relative_updates", 0.9, True),
    Target("idle share of the learner", "learner.idle_share", 0.05, False),
    Target("recording, share of an actor's steps/s", "recording.overhead", 0.05, False),
    Target("from `train` to the first environment step [s]", "system.first_step_s", 5, False),
)


def records() -> dict[str, dict[str, Any]]:
    """Returns all committed records by name."""
    files = [RESULTS / f"bench_{part}.json" for part in PARTS]
    found = [json.loads(file.read_text(encoding="utf-8")) for file in files if file.is_file()]
    return {record["name"]: record for part in found for record in part}


def verdict(target: Target, measured: float) -> str:
    """Returns "met", or by how much of the target the figure misses it."""
    if (measured >= target.limit) if target.is_least else (measured <= target.limit):
        return "met"
    return f"missed by {abs(measured / target.limit - 1):.0%}"


def document(measured: dict[str, dict[str, Any]]) -> str:
    """Returns the page, Markdown."""
    lines = [_HEAD, "## Targets", "", "| what | target | measured (least, greatest) | |", "|---|--:|--:|---|"]
    for target in TARGETS:
        record = measured.get(target.name)
        if record is None:
            lines.append(f"| {target.what} | {target.limit:,} | not measured | |")
            continue
        sign = "at least" if target.is_least else "at most"
        figures = f"{_number(record['median'])} ({_number(record['min'])}, {_number(record['max'])})"
        line = f"| {target.what} | {sign} {target.limit:,} | {figures} | {verdict(target, record['median'])} |"
        lines.append(line)
    lines += ["", _REASONS, "## Every record", "", "| name | unit | median | least | greatest | runs |"]
    lines.append("|---|---|--:|--:|--:|--:|")
    for name, record in measured.items():
        numbers = " | ".join(_number(record[key]) for key in ("median", "min", "max"))
        lines.append(f"| `{name}` | {record['unit']} | {numbers} | {record['runs']} |")
    return "\n".join(lines) + "\n"


def summary_line(measured: dict[str, dict[str, Any]]) -> str:
    """Returns how many targets are met and which are missed by how much, in one paragraph for the README."""
    verdicts = {target.what.partition(" [")[0]: verdict(target, measured[target.name]["median"]) for target in TARGETS}
    missed = [f"{what}, by {how.rpartition(' ')[2]}" for what, how in verdicts.items() if how != "met"]
    return f"{len(verdicts) - len(missed)} of {len(verdicts)} targets are met. Missed: {'; '.join(missed)}."


def _number(value: float) -> str:
    """Returns a number with three digits that count, and no decimals from 100 on."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


_HEAD = """# How fast it is

Made by `python -m benchmarks.performance` from `docs/results/bench_*.json`, which `apex-bat bench PART --json FILE`
writes on a checkout. Two shared virtual cores (x86-64, 2.0 GHz), no GPU, Python 3.11, torch 2.13.0 on one thread.
Medians; ratios are of one run, side by side. Figures in us are CPU time, all others wall time.
"""

_REASONS = """Why targets are missed:

- *Times of the replay core.* The limits were set where cpprb drew 512 of 50,000 in 429 us and of 1,000,000 in 739 us.
  Here it takes longer, see its records below, because other programs shared the machine; in proportion, the draws miss
  their limits by 4 % and 18 %. They are bound by memory: each of 512 transitions reads six frames at random places.
  Updates, and batches of 32, are dominated by the overhead of some twenty calls of numpy each; cpprb's are compiled.
- *Batches of the saturated server.* Inserts get more than their limit, batches less: four synthetic actors, which
  encode without pause, the server, and a learner, which decodes, share two cores, and the server gives actors and
  learner the same time. A run with the defaults asks for one batch of 64 every 15 ms.
- *The spread* between least and greatest tells how much else ran on the machine: other tests, all the while.
"""


if __name__ == "__main__":
    print(document(records()), end="")
