"""Hosts that a test plays, with a keeper on each, and what makes them."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from typing import NamedTuple

import msgspec

from apex_bat.config import load
from apex_bat.launching.cluster.keeper import Look, Site
from apex_bat.launching.cluster.kept import Fate, LostError
from apex_bat.roles.orders import Orders
from apex_bat.roles.plan import Role

REPLAY, LEARNER, ACTOR = Role("replay", 0), Role("learner", 0), Role("actor", 0)
CONFIG = load(None, ["cluster.lease_s=2.0", "launch.grace_s=1.0"])


class Call(NamedTuple):
    """A call that is under way."""

    host: Host
    method: str
    given: tuple[object, ...]

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other


class Host:
    """A keeper played by the test."""

    def __init__(self, number: int, role: Role, away_from: str, is_reserved: bool) -> None:
        self.number, self.role, self.away_from, self.is_reserved = number, role, away_from, is_reserved
        self.has_place = True
        self.is_lost = self.is_silent = self.is_dismissed = False
        self.problem = ""
        self.pids_differ = True
        self.error: Exception | None = None
        self.failing = ""
        """The method that is answered by `error`, while there is one."""
        self.starts: list[Orders] = []
        self.news: list[Orders] = []
        self.prepared: list[Role] = []
        self.ended = False
        self._looks = self._life = 0

    @property
    def node(self) -> str:
        return f"node{self.number}"

    def call(self, method: str, *given: object) -> object:
        return Call(self, method, given)

    def dismiss(self) -> None:
        self.is_dismissed = True

    def answer(self, method: str, given: tuple[object, ...]) -> object:
        if method == "site":
            self._port = 5000 + 100 * self.number + len(self.starts)
            return Site(f"host{self.number}", f"10.0.0.{self.number}", self._port, self.problem, self.node)
        if method == "start":
            life, orders = given[0], given[5]
            assert isinstance(life, int)
            self._life = life
            self.starts.append(_orders(orders))
            self.ended = False
            return self._pid()
        if method == "prepare":
            self.prepared.append(self.role)
        if method == "look":
            self._looks += 1
            if given[1] is not None:
                self.news.append(_orders(given[1]))
            return Look(self._looks, self._life or -1, self._pid(), self.ended, 4, "it ended")
        return None

    def _pid(self) -> int:
        return 1000 * (self.number if self.pids_differ else 1) + len(self.starts)


def _orders(line: object) -> Orders:
    assert isinstance(line, bytes)
    return msgspec.json.decode(line, type=Orders)


class Stage:
    """Makes hosts, one for each call."""

    def __init__(self) -> None:
        self.hosts: list[Host] = []
        self.prepare: Callable[[Host], None] = lambda _: None
        self.has_room = True
        self.fate: dict[str, Fate] = {}
        """Of nodes, where it is known."""

    def is_short(self) -> bool:
        return not self.has_room

    def asks(self, role: Role) -> str:
        return f"1 CPU for {role.name}"

    def fates(self, nodes: Collection[str]) -> dict[str, Fate]:
        return {node: self.fate.get(node, "unknown") for node in nodes}

    def reserves(self, role: Role) -> bool:
        return role.number == 0

    def place(self, role: Role, away_from: str = "", *, is_reserved: bool = True) -> Host:
        host = Host(len(self.hosts) + 1, role, away_from, is_reserved)
        self.prepare(host)
        self.hosts.append(host)
        return host

    def answers(self, tickets: list[object], timeout_s: float) -> Iterator[tuple[object, object]]:
        time.sleep(timeout_s / 10)
        for ticket in tickets:
            assert isinstance(ticket, Call)
            host, method, given = ticket
            if host.is_lost:
                yield ticket, LostError("the node died")
            elif host.error is not None and method == host.failing:
                yield ticket, host.error
            elif host.has_place and not host.is_silent:
                yield ticket, host.answer(method, given)


def until(condition: Callable[[], object]) -> None:
    ends_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < ends_s, "it did not happen within 20 s"
        time.sleep(0.01)
