"""Which reports become rows of the metrics: each at first, then ever fewer, so that the files of long runs stay small.

For `launch.dense_rows_s` every report is a row; later the period is elapsed / dense_rows_s seconds. A role that reports
each second so leaves dense_rows_s (1 + ln(elapsed / dense_rows_s)) rows: 26,000 in three weeks instead of 1,800,000.
"""

from __future__ import annotations

import msgspec
from msgspec import structs

from apex_bat.storage import State
from apex_bat.transport.messages import Report

_RATE, _COUNT = "_per_s", "_count"
_SLACK = 0.5  # of a report's period: the report that comes a moment too early is taken


class RowThinner:
    """Gathers the reports of each role until a row is due."""

    def __init__(self, dense_rows_s: float) -> None:
        self._dense_rows_s = dense_rows_s
        self._due_s: dict[str, float] = {}
        self._gathered: dict[str, list[Report]] = {}

    def take(self, report: Report, elapsed_s: float) -> Report | None:
        """Takes a report and returns that which becomes a row now, if one is due.

        When another process has taken a role's place, what its predecessor left becomes a row at once.

        Args:
            report: of any role.
            elapsed_s: time since the first environment step.
        """
        gathered = self._gathered.setdefault(report.role, [])
        if gathered and gathered[-1].pid != report.pid:
            row = joined(gathered)
            self._gathered[report.role] = [report]
            return row
        gathered.append(report)
        if elapsed_s < self._due_s.get(report.role, 0.0):
            return None
        period_s = elapsed_s / self._dense_rows_s
        self._due_s[report.role] = elapsed_s + period_s - _SLACK if period_s > 1.0 else 0.0
        row = joined(gathered)
        gathered.clear()
        return row

    def rest(self) -> list[Report]:
        """Returns what was gathered and is no row yet, one report a role, and forgets it."""
        rows = [joined(gathered) for gathered in self._gathered.values() if gathered]
        self._gathered.clear()
        return rows

    def state(self) -> State:
        """Returns what was gathered and when rows are due, for `restore`."""
        return State({"due_s": dict(self._due_s), "gathered": msgspec.to_builtins(self._gathered)}, {})

    def restore(self, state: State) -> None:
        """Continues from what `state` returned."""
        self._due_s = dict(state.values["due_s"])
        self._gathered = msgspec.convert(state.values["gathered"], dict[str, list[Report]])


def joined(reports: list[Report]) -> Report:
    """Returns consecutive reports of one process as one.

    Means are weighted by their counts, counts are added, rates and shares of time averaged; all else is the newest.
    """
    newest = reports[-1]
    if len(reports) == 1:
        return newest
    metrics = dict(newest.metrics)
    names = {name for report in reports for name in report.metrics}
    for name in names:
        counts = [report.metrics.get(name + _COUNT, 0.0) for report in reports]
        values = [report.metrics[name] for report in reports if name in report.metrics]
        if name + _COUNT in names:
            total = sum(report.metrics.get(name, 0.0) * count for report, count in zip(reports, counts, strict=True))
            metrics[name] = total / max(sum(counts), 1.0)
        elif name.endswith(_COUNT):
            metrics[name] = sum(values)
        elif name.endswith(_RATE) or name.startswith("share."):
            metrics[name] = sum(values) / len(reports)
    return structs.replace(newest, metrics=metrics)
