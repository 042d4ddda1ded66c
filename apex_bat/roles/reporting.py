"""How a role tells the launcher what it does: counters, means, gauges and the shares of its time."""

from __future__ import annotations

import copy
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Protocol

from apex_bat.roles.plan import Assignment
from apex_bat.roles.resources import own_resources
from apex_bat.storage import State
from apex_bat.transport.messages import Report
from apex_bat.transport.reports import Reporter

PERIOD_S = 1.0


class Phases:
    """Measures which share of the wall time a role spends in each of its phases."""

    def __init__(self, *names: str, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._spent_s = dict.fromkeys(names, 0.0)
        self._since = clock()

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Counts the time inside the block to a phase."""
        begin = self._clock()
        try:
            yield
        finally:
            self._spent_s[name] += self._clock() - begin

    def shares(self) -> dict[str, float]:
        """Returns each phase's share of the time since the last call, as `share.NAME`, and begins anew.

        Nothing where no phase took any time, as by the clock of the serial mode.
        """
        now = self._clock()
        elapsed_s = max(now - self._since, 1e-9)
        spent = self._spent_s.items() if any(self._spent_s.values()) else ()
        shares = {f"share.{name}": spent_s / elapsed_s for name, spent_s in spent}
        self._spent_s = dict.fromkeys(self._spent_s, 0.0)
        self._since = now
        return shares


class ReportLine(Protocol):
    """What carries the reports of a role to the launcher."""

    def send(self, report: Report) -> object:
        """Sends a report, or drops it."""

    def close(self) -> None:
        """Ends the line."""


class RoleReporter:
    """Gathers a role's figures and sends them about once a second. Sending never blocks."""

    def __init__(
        self,
        assignment: Assignment,
        address: str = "",
        resources: Callable[[], Mapping[str, float]] = own_resources,
        line: ReportLine | None = None,
    ) -> None:
        """Takes the role's part of the run, and what it reports beside its figures.

        Args:
            assignment: the role, its clock, and where it reports to.
            address: where the role listens, if it does.
            resources: measures what its process uses.
            line: what carries the reports; None: ZeroMQ, to the address of the assignment.
        """
        self._role = assignment.role.name
        self._pid, self._host, self._address = assignment.pid, assignment.host, address
        self._line = line or _reporter(assignment)
        self._clock = assignment.clock
        self._totals: defaultdict[str, float] = defaultdict(float)
        self._resources = resources
        self._gauges: dict[str, float] = {}
        self._sums: dict[str, tuple[float, int]] = {}
        self._sent_s = self._clock()

    @property
    def is_due(self) -> bool:
        """Whether the last report is a second old."""
        return self._clock() - self._sent_s >= PERIOD_S

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
        now_s = self._clock()
        elapsed_s = max(now_s - self._sent_s, 1e-9)
        metrics = {**self._gauges, **self._resources()}
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
        self._line.send(report)
        self._sent_s = now_s

    def state(self) -> State:
        """Returns what was gathered and not sent yet, the counters, and when the last report went."""
        sums = {name: list(pair) for name, pair in self._sums.items()}
        values = {"totals": dict(self._totals), "gauges": self._gauges, "sums": sums, "sent_s": self._sent_s}
        return State(copy.deepcopy(values), {})

    def restore(self, state: State) -> None:
        """Continues from what `state` returned, by a clock that goes on from there."""
        self._totals = defaultdict(float, state.values["totals"])
        self._gauges = dict(state.values["gauges"])
        self._sums = {name: (total, number) for name, (total, number) in state.values["sums"].items()}
        self._sent_s = state.values["sent_s"]

    def close(self) -> None:
        """Closes the line."""
        self._line.close()


def _reporter(assignment: Assignment) -> Reporter:
    addresses = assignment.addresses
    return Reporter(addresses.reports, keys=assignment.keys(), generation=addresses.reports_generation)
