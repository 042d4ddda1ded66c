"""A keeper as the launcher holds it: the calls that are under way to it, and the life of the role that it keeps now."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Literal, Protocol

from apex_bat.launching.cluster.keeper import Site
from apex_bat.launching.cluster.lease import Hearing
from apex_bat.launching.cluster.placed import Order, Placed
from apex_bat.roles.plan import Role

MOST_FAILED_STARTS = 3
"""How often in a row a keeper may fail to start its role; then it is dismissed, and another place is looked for."""

Fate = Literal["unknown", "refusing", "removed"]
"""Of a node: nothing is known; it refuses what Ray's own daemon would take, so that no keeper lives there any more; the
cluster itself has counted it out."""
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

    def place(self, role: Role, away_from: str = "", *, is_reserved: bool = True) -> Remote:
        """Returns a keeper for a role; it may have no place for long.

        Args:
            role: which.
            away_from: node that is not to be its place; empty: any will do.
            is_reserved: whether a place that is reserved for the role is to be taken.
        """

    def reserves(self, role: Role) -> bool:
        """Whether a place is reserved for a role."""

    def fates(self, nodes: Collection[str]) -> dict[str, Fate]:
        """Returns what is known of nodes whose keepers are silent; takes half a second at most, head permitting."""

    def is_short(self) -> bool:
        """Whether the cluster has no place at present for the roles that hold theirs: all but the further actors."""

    def answers(self, tickets: list[Ticket], timeout_s: float) -> Iterator[tuple[Ticket, object]]:
        """Yields ticket and answer, or the error, of those that are answered within the time.

        The error is a LostError if the keeper is gone, else what its method raised.
        """


class Kept:
    """A keeper, and the life of its role that it keeps now."""

    def __init__(
        self, role: Role, lease_s: float, now_s: float, not_before_s: float = 0.0, away_from: str = ""
    ) -> None:
        """Asks for no place yet.

        Args:
            role: which.
            lease_s: see `lease`.
            now_s: the time.
            not_before_s: when a place may be asked for: what ran on the keeper before has ended then.
            away_from: node where the role was before, which may not be well.
        """
        self.role, self.not_before_s, self.away_from = role, not_before_s, away_from
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
        self.is_reserved = True
        """Whether the place that is reserved for the role is asked for."""
        self.num_asks = 0
        """How often its place was asked for in vain."""
        self.num_refusals = 0
        """How often in a row its node has said that it is gone."""
        self.is_lost = self.is_known_lost = False
        """Whether it is gone, and whether the cluster said so, which then offers no place on a node that is gone."""
        self.next: Kept | None = None
        """Where the role goes if this one is lost: found in advance while nothing is heard of it."""
        self.is_in_advance = False
        """Whether it is the `next` of another, and keeps nothing yet."""
        self.is_useless = False
        """Whether no role can be started there, although its keeper lives."""

    @property
    def doubtful_node(self) -> str:
        """Where the role should not go next: where it was, as long as the cluster itself knows nothing of a loss."""
        return "" if self.site is None or self.is_known_lost else self.site.node

    @property
    def has_no_place(self) -> bool:
        """Whether it has no place yet, and waits for one."""
        return self.site is None and not self.is_lost and not self.placed.is_over

    def waits_s(self, now_s: float) -> float:
        """Returns for how long its place has been asked for in vain; 0 if none is asked for, or there is one."""
        return now_s - self.asked_s if self.remote is not None and self.site is None and not self.is_lost else 0.0

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

    def lose(self, reason: str) -> None:
        """Notes that the keeper is gone, or is to go: it may only be out of reach. The role needs another one."""
        self.dismiss()
        self.is_lost = True
        if not self.is_in_advance:
            self.placed.take_loss(reason)

    def begin_next(self, now_s: float) -> None:
        """Asks for the next place, where nothing is started before this one's life is over: to find it takes long."""
        self.next = Kept(self.role, self.hearing.lease_s, now_s, away_from=self.doubtful_node)
        self.next.placed, self.next.is_in_advance = self.placed, True

    def drop_next(self) -> None:
        """Gives the next place back."""
        if self.next is not None:
            self.next.dismiss()
            self.next = None

    def ask_anew(self, now_s: float, *, is_reserved: bool) -> None:
        """Takes back what was asked for in vain, and asks for the reserved place, or for one anywhere else."""
        self.dismiss()
        self.remote, self.away_from, self.is_reserved, self.asked_s = None, "", is_reserved, now_s
        self.num_asks += 1
        self.under_way.clear()


def with_next(several: Iterable[Kept]) -> list[Kept]:
    """Returns keepers, and behind each the one that was asked for in advance."""
    return [one for kept in several for one in (kept, kept.next) if one is not None]
