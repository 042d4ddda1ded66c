"""How a role tells the launcher what it does: counters, means, gauges and the shares of its time."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

from apex_bat.roles.plan import Assignment
from apex_bat.transport.messages import Report
from apex_bat.transport.reports import Reporter

PERIOD_S = 1.0


class Phases:
    """Measures which share of the wall time a role spends in each of its phases."""

    def __init__(self, *names: str) -> None:
        self._spent_s = dict.fromkeys(names, 0.0)
        self._since = time.perf_counter()

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Counts the time inside the block to a phase."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self._spent_s[name] += time.perf_counter() - begin

    def shares(self) -> dict[str, float]:
        """Returns each phase's share of the time since the last call, as `share.NAME`, and begins anew."""
        now = time.perf_counter()
        elapsed_s = max(now - self._since, 1e-9)
        shares = {f"share.{name}": spent_s / elapsed_s for name, spent_s in self._spent_s.items()}
        self._spent_s = dict.fromkeys(self._spent_s, 0.0)
        self._since = now
        return shares


class RoleReporter:
    """Gathers a role's figures and sends them about once a second. Sending never blocks."""

    def __init__(self, assignment: Assignment, address: str = "") -> None:
        """`address` is where the role listens, if it does."""
        self._role = assignment.role.name
        self._pid, self._host, self._address = assignment.pid, assignment.host, address
        self._reporter = Reporter(assignment.addresses.reports, keys=assignment.keys())
        self._totals: defaultdict[str, float] = defaultdict(float)
        self._gauges: dict[str, float] = {}
        self._sums: dict[str, tuple[float, int]] = {}
        self._sent_s = time.monotonic()

    @property
    def is_due(self) -> bool:
        """Whether the last report is a second old."""
        return time.monotonic() - self._sent_s >= PERIOD_S

    def count(self, name: str, more: float) -> None:
        """Adds to a counter that runs over the whole life of the role; its rate goes along as `NAME_per_s`."""
        self._totals[name] += more
        self._totals[f"{name}_per_s"] += more

    def average(self, name: str, value: float) -> None:
        """Adds to a mean over the time until the next report; without values there is no such figure in it."""
        total, number = self._sums.get(name, (0.0, 0))
        self._sums[name] = (total + value, number + 1)

    def gauge(self, name: str, value: float) -> None:
        """Sets what stands as it is in the next report."""
        self._gauges[name] = float(value)

    def send(self, state: str, phases: Phases | None = None) -> None:
        """Sends what was gathered and says what the role is doing or waiting for."""
        now_s = time.monotonic()
        elapsed_s = max(now_s - self._sent_s, 1e-9)
        metrics = dict(self._gauges)
        for name, total in self._totals.items():
            metrics[name] = total / elapsed_s if name.endswith("_per_s") else total
        for name in self._totals:
            if name.endswith("_per_s"):
                self._totals[name] = 0.0
        metrics |= {name: total / number for name, (total, number) in self._sums.items()}
        metrics |= {f"{name}_count": float(number) for name, (_, number) in self._sums.items()}
        self._sums.clear()
        if phases is not None:
            metrics |= phases.shares()
        report = Report(self._role, self._pid, self._host, self._address, state, metrics)
        self._reporter.send(report)
        self._sent_s = now_s

    def close(self) -> None:
        """Closes the socket."""
        self._reporter.close()
