"""A keeper as the launcher holds it: the calls that are under way to it, and the life of the role that it keeps now."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

from apex_bat.launching.cluster.keeper import Site
from apex_bat.launching.cluster.lease import Hearing
from apex_bat.launching.cluster.placed import Order, Placed
from apex_bat.roles.plan import Role

MOST_FAILED_STARTS = 3
"""How often in a row a keeper may fail to start its role; then it is dismissed, and another place is looked for."""

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
        """Whether the cluster has no place at present for the roles that hold theirs: all but the further actors."""

    def answers(self, tickets: list[Ticket], timeout_s: float) -> Iterator[tuple[Ticket, object]]:
        """Yields ticket and answer, or the error, of those that are answered within the time.

        The error is a LostError if the keeper is gone, else what its method raised.
        """


class Kept:
    """A keeper, and the life of its role that it keeps now."""

    def __init__(self, role: Role, lease_s: float, now_s: float, not_before_s: float = 0.0) -> None:
        """Asks for no place yet.

        Args:
            role: which.
            lease_s: see `lease`.
            now_s: the time.
            not_before_s: when a place may be asked for: what ran on the keeper before has ended then.
        """
        self.role, self.not_before_s = role, not_before_s
        self.remote: Remote | None = None  # None: no place is asked for yet
        self.asked_s = now_s
        self.hearing = Hearing(lease_s)
        self.placed: Placed
        self.site: Site | None = None
        self.incarnation = self.flown_steps = 0
        self.told_version = -1
        """Of the directory, that the role knows; -1: it may know none."""
        self.under_way: dict[Ticket, tuple[str, int]] = {}  # method and life of each call
        self.look_due_s = 0.0
        self.failed_starts = 0
        self.is_lost = False
        self.is_useless = False
        """Whether no role can be started there, although its keeper lives."""

    @property
    def has_no_place(self) -> bool:
        """Whether it has no place yet, and waits for one."""
        return self.site is None and not self.is_lost and not self.placed.is_over

    def ask(self, method: str, *given: object) -> None:
        """Calls a method of the keeper, if there is one; the answer comes to the life of now."""
        if self.remote is not None:
            self.under_way[self.remote.call(method, *given)] = method, self.placed.life

    def orderer(self) -> Callable[[Order], None]:
        """Returns what passes an order on to the keeper, whose answer nobody waits for."""

        def order(what: Order) -> None:
            if self.remote is not None:
                self.remote.call(what)

        return order

    def dismiss(self) -> None:
        """Ends the keeper."""
        if self.remote is not None:
            self.remote.dismiss()

    def leave_place(self, reason: str) -> None:
        """Gives the place back: its keeper ends, and the role needs another one."""
        self.dismiss()
        self.is_lost = True
        self.placed.take_loss(reason)
