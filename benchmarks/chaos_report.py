"""What came of a run under chaos: recovery times, losses, accounts, leftovers and resources; and the table of it.

    python -m benchmarks.chaos_report docs/results/chaos.json docs/reliability.md

puts the table of a result into the documentation.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from apex_bat.evaluation.runs import load_config

UNDISTURBED = Path("docs/results/memory_simple.json")
GROWTH_SHARE, GROWTH_MB, GROWTH_FILES = 0.15, 40.0, 10
"""How much memory and open files of a role may differ between the first and the last third of a run."""
SETTLED_S = 8.0
"""Age from which a process's memory is compared."""
END_MARGIN_PERIODS = 2.5
"""How long before the end of training the last fault comes, in periods of the schedule."""
RECOVERY_S, MOST_CUT_OFF_S = 15.0, 40.0
"""What a recovery may take; and how short before the end a fault need not have been recovered from, at most."""
BEGIN, END = "<!-- chaos: begin -->\n", "\n<!-- chaos: end -->"
_RESTORED = re.compile(r"continues: replay: \d+ transitions, (\d+) ever inserted")


class Fault(NamedTuple):
    """A fault that was done."""

    kind: str
    roles: tuple[str, ...]
    pids: tuple[int, ...]
    at_unix_s: float
    saved_unix_s: float | None
    """When the newest snapshot of the replay had been written; None: there was none."""


class Course(NamedTuple):
    """How the faults of a run came, one after the other."""

    faults: Sequence[Fault]
    period_s: float
    """Between two faults."""
    stuck: str
    """What did not work again in time, so that no more faults came; empty: none."""


class Sample(NamedTuple):
    """The status at a moment."""

    unix_s: float
    roles: dict[str, dict[str, Any]]
    launcher: dict[str, float]


class Timeline:
    """What the status said, each different one once."""

    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.first_seen: dict[int, Sample] = {}
        """The first sample that holds a report of a process, by its pid."""
        self._written_s = 0.0

    @property
    def newest(self) -> Sample | None:
        """The last sample."""
        return self.samples[-1] if self.samples else None

    def take(self, content: dict[str, Any], unix_s: float) -> Sample | None:
        """Notes a status if it is new, and returns it."""
        if content["written_unix_s"] == self._written_s or content.get("ended"):
            return None
        self._written_s = content["written_unix_s"]
        sample = Sample(unix_s, {row["role"]: row for row in content["roles"]}, content.get("launcher_metrics", {}))
        self.samples.append(sample)
        for row in sample.roles.values():
            if row["pid"] is not None and _is_heard(row):
                self.first_seen.setdefault(row["pid"], sample)
        return sample


def is_flowing(role: str, timeline: Timeline, sample: Sample | None = None) -> bool:
    """Whether the present process of a role does its work: experience goes in, or batches out, or it was heard."""
    sample = sample or timeline.newest
    if sample is None:
        return False
    row = sample.roles[role]
    if row["pid"] is None or not _is_heard(row):
        return False
    metrics = row["metrics"]
    if role == "replay":
        first = timeline.first_seen[row["pid"]].roles[role]["metrics"]
        return all(metrics.get(name, 0) > first.get(name, 0) for name in ("replay.inserted", "replay.sampled"))
    work = {"learner": "updates", "evaluator": "process.memory_mb"}.get(role, "env_steps")
    return bool(metrics.get(work, 0) > 0)


def cut_off_s(period_s: float) -> float:
    """Returns how short before the end a fault need not have been recovered from, of a schedule with such a period."""
    return min(END_MARGIN_PERIODS * period_s + RECOVERY_S, MOST_CUT_OFF_S)


def report(folder: Path, timeline: Timeline, course: Course, code: int | None) -> dict[str, Any]:
    """Returns all figures and checks of a run that is over; `code` is its exit code."""
    faults = course.faults
    rows = [json.loads(line) for line in _text(folder / "metrics" / "replay.jsonl").splitlines()]
    began_s = timeline.samples[0].unix_s if timeline.samples else 0.0
    most_s = cut_off_s(course.period_s)
    done = [_recovery(fault, timeline, most_s) | {"at_s": round(fault.at_unix_s - began_s, 1)} for fault in faults]
    losses = _losses(folder, rows, faults)
    facts = json.loads(_text(folder / "run.json") or "{}")
    leftovers = leftovers_of(folder)
    resources = _resources(timeline, load_config(folder).replay.capacity)
    final = _evaluation(folder / "evaluation" / "final.json")
    checks = {
        "the run ended as asked": code == 0 and facts.get("outcome") == "completed",
        "every fault was recovered from": all(one["flowing_s"] is not None or one["is_cut_off"] for one in done),
        "every role worked again before the next fault": not course.stuck,
        "every transition is accounted for": bool(rows) and all(map(_adds_up, rows)),
        "no snapshot lost more than came after it": all(loss["within_bound"] for loss in losses),
        "no process is left": not processes_of(folder),
        "no unfinished file or socket is left": not leftovers,
        "memory and open files stay flat": all(one["is_flat"] for one in resources.values()),
    }
    return {
        "checks": checks,
        "recovery": [_summary(kind, done) for kind in dict.fromkeys(one["kind"] for one in done)],
        "faults": done,
        "losses": losses,
        "transitions": {name: rows[-1].get(f"replay.{name}") for name in ("inserted", "size", "evicted", "refused")}
        if rows
        else {},
        "env_steps": facts.get("env_steps"),
        "learner_steps": facts.get("learner_steps"),
        "resources": resources,
        "hits": sum(len(fault.roles) for fault in faults),
        "restarts": sum(row["restarts"] for row in timeline.samples[-1].roles.values()) if timeline.samples else 0,
        "leftovers": leftovers,
        "stuck": course.stuck,
        "evaluation": final,
        "undisturbed": _evaluation(UNDISTURBED),
    }


def document(result: dict[str, Any]) -> str:
    """Returns the result as the Markdown that docs/reliability.md holds."""
    lines = ["| fault | times | replaced after [s], median | max | works again after [s], median | max |",
             "|---|--:|--:|--:|--:|--:|"]  # fmt: skip
    for row in result["recovery"]:
        figures = (row[name] for name in ("replaced_median_s", "replaced_max_s", "flowing_median_s", "flowing_max_s"))
        lines.append(f"| {row['kind']} | {row['times']} | " + " | ".join(map(_number, figures)) + " |")
    lost = [loss["lost_at_least"] for loss in result["losses"]]
    inserted = result["transitions"].get("inserted") or 0
    lines += [
        "",
        f"- {len(result['faults'])} faults in {result['minutes']:g} minutes, seed {result['seed']}; "
        f"{_count(result['env_steps'])} steps, {_count(result['learner_steps'])} updates, "
        f"{_count(inserted)} transitions stored.",
        f"- Processes hit: {result['hits']}; processes started again: {result['restarts']}.",
        f"- Transitions lost with a killed replay server: {', '.join(f'{each:,.0f}' for each in lost) or 'none'}.",
        f"- Children of a killed launcher were gone after {result['launcher_killed']['roles_ended_after_s']:.1f} s.",
    ]
    if result["evaluation"] and result["undisturbed"]:
        ours, theirs = result["evaluation"], result["undisturbed"]
        lines.append(f"- Test flights completed: {ours['completed']} of {ours['flights']}; the undisturbed run of the "
                     f"README: {theirs['completed']} of {theirs['flights']}.")  # fmt: skip
    lines += [f"- {'Held' if held else '**Did not hold**'}: {check}." for check, held in result["checks"].items()]
    return "\n".join(lines)


def _is_heard(row: dict[str, Any]) -> bool:
    """Whether the newest report is of the present process: then its state is not that of one that starts."""
    return row["state"] != "starting" and not row["state"].startswith("waiting to be")


def _recovery(fault: Fault, timeline: Timeline, most_s: float) -> dict[str, Any]:
    """When each victim was replaced, and when the last of them worked again, in s after the fault."""
    replaced: list[float] = []
    flowing: list[float] = []
    after = [sample for sample in timeline.samples if sample.unix_s > fault.at_unix_s]
    for role, pid in zip(fault.roles, fault.pids, strict=True):
        new = [sample for sample in after if sample.roles[role]["pid"] not in (None, pid)]
        works = [sample for sample in new if is_flowing(role, timeline, sample)]
        replaced += [new[0].unix_s - fault.at_unix_s] if new else []
        flowing += [works[0].unix_s - fault.at_unix_s] if works else []
    everybody = len(fault.roles)
    return {
        "kind": fault.kind,
        "roles": list(fault.roles),
        "replaced_s": round(max(replaced), 2) if len(replaced) == everybody else None,
        "flowing_s": round(max(flowing), 2) if len(flowing) == everybody else None,
        "is_cut_off": not after or after[-1].unix_s - fault.at_unix_s < most_s,
    }


def _summary(kind: str, faults: Sequence[dict[str, Any]]) -> dict[str, Any]:
    row: dict[str, Any] = {"kind": kind, "times": sum(one["kind"] == kind for one in faults)}
    for name in ("replaced", "flowing"):
        values = [one[f"{name}_s"] for one in faults if one["kind"] == kind and one[f"{name}_s"] is not None]
        row[f"{name}_median_s"] = round(statistics.median(values), 2) if values else None
        row[f"{name}_max_s"] = max(values, default=None)
    return row


def _losses(folder: Path, rows: Sequence[dict[str, Any]], faults: Sequence[Fault]) -> list[dict[str, Any]]:
    """What each end of a replay server lost: from its last report to what the next one restored, in the log's order."""
    text = "".join(_text(path) for path in sorted((folder / "logs").glob("replay.log*"), reverse=True))
    lives = text.split(" starts, pid ")[1:]
    losses = []
    hits = [fault for fault in faults if "replay" in fault.roles]
    for fault in hits:
        pid = fault.pids[fault.roles.index("replay")]
        order = next((i for i, life in enumerate(lives) if life.startswith(f"{pid}\n")), None)
        before = [row for row in rows if row["pid"] == pid]
        if order is None or order + 1 >= len(lives) or not before:
            continue
        found = _RESTORED.search(lives[order + 1])
        restored = int(found[1]) if found else 0
        inserted = before[-1]["replay.inserted"]
        # What the newest snapshot on disk must hold: all that was reported a second before it was through.
        saved = [row for row in before if fault.saved_unix_s and row["unix_s"] <= fault.saved_unix_s - 3.0]
        losses.append(
            {
                "kind": fault.kind,
                "inserted": inserted,
                "restored": restored,
                "lost_at_least": max(inserted - restored, 0.0),
                "after_snapshot_s": round(fault.at_unix_s - fault.saved_unix_s, 1) if fault.saved_unix_s else None,
                "within_bound": not saved or restored >= saved[-1]["replay.inserted"],
            }
        )
    return losses


def _adds_up(row: dict[str, Any]) -> bool:
    """Whether a report of the replay accounts for every transition."""
    inserted = row["replay.inserted"]
    return bool(
        inserted == row["replay.size"] + row["replay.evicted"]
        and row["replay.received"] == inserted + row["replay.refused"]
    )


def _resources(timeline: Timeline, capacity: int) -> dict[str, Any]:
    """Memory and open files of each role in the first and the last third of the run, of processes that have settled."""
    result: dict[str, Any] = {}
    names = [*timeline.samples[0].roles] if timeline.samples else []
    for name in [*names, "launcher"]:
        points = []
        for sample in timeline.samples:
            row = sample.roles.get(name, {"pid": 0, "metrics": sample.launcher, "state": ""})
            began = timeline.first_seen.get(row["pid"], timeline.samples[0]).unix_s
            if "process.memory_mb" in row["metrics"] and _is_heard(row) and sample.unix_s - began >= SETTLED_S:
                metrics = row["metrics"]
                # The replay's arrays become the process's memory as they fill.
                held_mb = metrics.get("replay.mb", 0.0) * metrics.get("replay.size", 0.0) / capacity
                points.append((metrics["process.memory_mb"] - held_mb, metrics["process.open_files"]))
        third = len(points) // 3
        if third == 0:
            continue
        first, last = points[:third], points[-third:]
        (mb, files), (mb_end, files_end) = ([statistics.median(column) for column in zip(*part, strict=True)]
                                            for part in (first, last))  # fmt: skip
        result[name] = {
            "memory_mb": [round(mb, 1), round(mb_end, 1)],
            "open_files": [files, files_end],
            "is_flat": mb_end - mb <= GROWTH_MB + GROWTH_SHARE * mb and files_end - files <= GROWTH_FILES,
        }
    return result


def leftovers_of(folder: Path, killed_launcher: int | None = None) -> list[str]:
    """Returns files that should not be there: unfinished ones (but recordings, which can be opened) and sockets.

    A launcher that was killed, given by its pid, could not remove the run's sockets and what it was just writing.
    """
    found = sorted(
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if (path.name.endswith((".part", ".writing")) and path.parent.name != "recordings") or path.is_socket()
    )
    if killed_launcher is None:
        return found
    return [name for name in found if not name.startswith("sockets/") and not name.endswith(f".{killed_launcher}.part")]


def processes_of(folder: Path) -> list[int]:
    """Returns processes whose command names the run folder."""
    return [each.pid for each in psutil.process_iter(["cmdline"]) if str(folder) in (each.info["cmdline"] or [])]


def _evaluation(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    row = json.loads(path.read_text(encoding="utf-8"))["summary"][0]
    return {name: row[name] for name in ("arena", "completed", "flights", "progress_m_mean")}


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""


def _count(value: float | None) -> str:
    return "-" if value is None else f"{value:,.0f}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _fill_in(result: Path, page: Path) -> None:
    """Puts the table of a result between the marks of a page."""
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    table = document(json.loads(result.read_text(encoding="utf-8")))
    page.write_text(before + BEGIN + table + END + rest.partition(END)[2], encoding="utf-8")


if __name__ == "__main__":
    _fill_in(Path(sys.argv[1]), Path(sys.argv[2]))
