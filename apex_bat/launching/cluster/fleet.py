"""The keepers of a run on a cluster: a thread looks at each twice a second, starts what is due and passes news on.

A thread of its own, because the leases of all roles hang on it: a slow disk under the launcher must not end them. It
knows nothing of Ray; whoever makes keepers and carries the calls to them is handed in.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Protocol

from apex_bat.config import Config
from apex_bat.launching.cluster.directory import Directory, new_generation
from apex_bat.launching.cluster.keeper import Look, Site, versions_here
from apex_bat.launching.cluster.lease import Hearing
from apex_bat.launching.cluster.placed import Order, Placed
from apex_bat.launching.cluster.placement import ClusterError
from apex_bat.launching.processes import threads_of
from apex_bat.roles.orders import line_of
from apex_bat.roles.plan import Role
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import Keys

LOOK_S = 0.5
"""Between two looks at a keeper."""
PATIENCE_S = 3.0
"""How long replay, learner or evaluator may be without a place until actors leave theirs."""
ROOM_PERIOD_S = 2.0
"""Between two actors that leave their places."""
_WAIT_S = 0.1
_log = logging.getLogger(__name__)

Ticket = object
"""Stands for the answer to a call that is under way."""


class LostError(RuntimeError):
    """A keeper is gone."""


class Remote(Protocol):
    """A keeper on some host, or on the way to one."""

    def call(self, method: str, *given: object) -> Ticket:
        """Calls a method of `Keeper`; returns at once."""

    def dismiss(self) -> None:
        """Ends it, wherever it is, as far as it can be reached."""


class Placer(Protocol):
    """What makes keepers."""

    def asks(self, role: Role) -> str:
        """Returns what a role asks of the cluster, as text."""

    def place(self, role: Role) -> Remote:
        """Returns a keeper for a role; it may have no place for long."""

    def is_short(self) -> bool:
        """Whether the cluster has no place at present for all roles but the actors."""

    def answers(self, tickets: list[Ticket], timeout_s: float) -> Iterator[tuple[Ticket, object]]:
        """Yields ticket and answer, or the error, of those that are answered within the time.

        The error is a LostError if the keeper is gone, else what its method raised.
        """


class _Kept:
    """A keeper, and the life of its role that it keeps now."""

    def __init__(self, role: Role, lease_s: float, now_s: float) -> None:
        self.role = role
        self.remote: Remote | None = None  # None: no place is asked for yet
        self.asked_s = now_s
        self.hearing = Hearing(lease_s)
        self.placed: Placed
        self.site: Site | None = None
        self.incarnation = self.flown_steps = 0
        self.told_version = -1
        self.under_way: dict[Ticket, tuple[str, int]] = {}  # method and life of each call
        self.look_due_s = 0.0
        self.is_lost = False


class Fleet:
    """Starts roles in places of a cluster; as a context, its thread runs while the block lasts."""

    def __init__(self, config: Config, collector: ReportCollector, keys: Keys, placer: Placer) -> None:
        """Takes what every role is told, and what makes keepers."""
        self._config, self._collector, self._keys, self._placer = config, collector, keys, placer
        self._directory = Directory(collector.address, config.replay.shards)
        self._kept: dict[str, _Kept] = {}
        self._num_lives = 0
        self._is_short, self._room_due_s = False, 0.0
        self._lock = threading.Lock()
        self._is_closed = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)

    def __enter__(self) -> Fleet:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_closed.set()
        self._thread.join()
        for kept in self._kept.values():
            _dismiss(kept)

    def start(self, role: Role, incarnation: int, flown_steps: int) -> Placed:
        """Starts a role where it was before, if its keeper lives, or in a new place; returns at once.

        Raises:
            ClusterError: the thread has failed.
        """
        if self._error is not None:
            raise ClusterError(f"the thread that looks at the keepers failed: {self._error!r}")
        with self._lock:
            kept = self._kept.get(role.name)
            if kept is None or kept.is_lost or kept.hearing.is_over(time.monotonic()):
                if kept is not None:
                    _dismiss(kept)
                kept = self._kept[role.name] = _Kept(role, self._config.cluster.lease_s, time.monotonic())
            self._num_lives += 1
            kept.placed = Placed(
                role, self._num_lives, self._placer.asks(role), self._config, kept.hearing, _order_to(kept)
            )
            kept.incarnation, kept.flown_steps, kept.site = incarnation, flown_steps, None
            kept.asked_s = time.monotonic()
            if kept.remote is not None:
                self._ask(kept, "site", versions_here())
            else:
                self._place(kept)
            return kept.placed

    @property
    def is_waiting(self) -> bool:
        """Whether a role has no place yet."""
        with self._lock:
            return any(_has_no_place(kept) for kept in self._kept.values())

    def _run(self) -> None:
        try:
            self._look_after_all()
        except Exception as error:  # whatever it is: nobody would hear of the roles any more
            _log.exception("failed")
            self._error = error
            for kept in self._kept.values():
                kept.placed.take_loss(f"the launcher's thread failed: {error!r}")

    def _look_after_all(self) -> None:
        while not self._is_closed.is_set():
            with self._lock:
                self._make_room(time.monotonic())
                for kept in self._kept.values():
                    self._advance(kept)
                owners = {ticket: kept for kept in self._kept.values() for ticket in kept.under_way}
            for ticket, answer in self._placer.answers(list(owners), _WAIT_S):
                with self._lock:
                    self._take(owners[ticket], ticket, answer)

    def _advance(self, kept: _Kept) -> None:
        """Starts the role if it is due, and looks at the keeper if that is."""
        now_s = time.monotonic()
        placed = kept.placed
        self._place(kept)
        if kept.is_lost or (kept.hearing.heard_s is None and kept.site is None):
            return
        is_ready = kept.site is not None and bool(placed.waiting) and not placed.is_over
        if is_ready and self._begin(kept, placed):
            kept.look_due_s = now_s + LOOK_S
        elif now_s >= kept.look_due_s and all(method != "look" for method, _ in kept.under_way.values()):
            kept.look_due_s = now_s + LOOK_S
            self._ask(kept, "look", kept.hearing.seen, self._news_for(kept))

    def _place(self, kept: _Kept) -> None:
        """Asks for a place, if that is not done yet and the role's turn has come."""
        is_held = self._is_short and kept.role.kind == "actor"
        if kept.remote is None and not is_held and not kept.placed.is_over:
            kept.remote = self._placer.place(kept.role)
            self._ask(kept, "site", versions_here())

    def _make_room(self, now_s: float) -> None:
        """Takes places from actors while the cluster has none for a role without which nothing is learned."""
        if now_s < self._room_due_s:
            return
        actors = [kept for kept in self._kept.values() if kept.role.kind == "actor"]
        since_s = min(
            (kept.asked_s for kept in self._kept.values() if kept.role.kind != "actor" and _has_no_place(kept)),
            default=now_s,
        )
        self._is_short = now_s - since_s > PATIENCE_S and self._placer.is_short()
        if not self._is_short:
            return
        self._room_due_s = now_s + ROOM_PERIOD_S
        for kept in actors:
            if _has_no_place(kept):  # or it would take what becomes free
                _dismiss(kept)
                kept.remote = None
                kept.under_way.clear()
        victim = next((kept for kept in reversed(actors) if kept.site is not None and not kept.is_lost), None)
        if victim is not None:
            _log.warning("%s: leaves its place to a role that has none", victim.role.name)
            _dismiss(victim)
            victim.is_lost = True
            victim.placed.take_loss("its place went to a role without which nothing is learned")

    def _begin(self, kept: _Kept, placed: Placed) -> bool:
        """Orders the role to be started; returns whether all that it needs has a place."""
        role, generation = placed.role, new_generation()
        addresses = self._directory.addresses_for(role, generation)
        if addresses is None:
            return False
        self._collector.generations[role.name] = generation
        kept.told_version = self._directory.version
        keys = self._keys if role.kind in ("replay", "learner") else self._keys.of_client()
        placed.begin()
        self._ask(
            kept, "start", placed.life, role, kept.incarnation, threads_of(role, self._config),
            kept.flown_steps, line_of(addresses, keys),
        )  # fmt: skip
        return True

    def _news_for(self, kept: _Kept) -> bytes | None:
        """Returns orders for a role that does not know the newest addresses; None if there is no news."""
        placed = kept.placed
        if placed.waiting or kept.told_version == self._directory.version:
            return None
        addresses = self._directory.addresses_for(placed.role, self._collector.generations[placed.role.name])
        if addresses is None:
            return None
        kept.told_version = self._directory.version
        return line_of(addresses)

    def _take(self, kept: _Kept, ticket: Ticket, answer: object) -> None:
        method, life = kept.under_way.pop(ticket)
        placed = kept.placed
        if isinstance(answer, LostError):
            if not kept.is_lost:
                _log.warning("%s: its keeper is lost: %s", placed.role.name, answer)
            kept.is_lost = True
            placed.take_loss(str(answer))
        elif isinstance(answer, Look):
            kept.hearing.take(time.monotonic(), answer.number)
            placed.take_look(answer)
        elif life != placed.life or method == "look":
            return  # of a former life, or a look that did not come through
        elif isinstance(answer, Exception):
            placed.take_error(answer)
        elif isinstance(answer, Site):
            self._take_site(kept, placed, answer)
        elif method == "start" and isinstance(answer, int):
            placed.take_start(answer)

    def _take_site(self, kept: _Kept, placed: Placed, site: Site) -> None:
        kept.site = site
        kept.hearing.take(time.monotonic())
        if placed.take_site(site):
            _log.info("%s: has a place on %s (%s)", placed.role.name, site.host, site.address)
            self._directory.settle(placed.role, f"tcp://{site.address}:{site.port}")

    def _ask(self, kept: _Kept, method: str, *given: object) -> None:
        if kept.remote is not None:
            kept.under_way[kept.remote.call(method, *given)] = method, kept.placed.life


def _order_to(kept: _Kept) -> Callable[[Order], None]:
    def order(what: Order) -> None:
        if kept.remote is not None:
            kept.remote.call(what)

    return order


def _has_no_place(kept: _Kept) -> bool:
    return kept.site is None and not kept.is_lost and not kept.placed.is_over


def _dismiss(kept: _Kept) -> None:
    if kept.remote is not None:
        kept.remote.dismiss()
