"""The lease on which a role lives on another machine: it ends there before a replacement begins elsewhere.

The launcher looks at each keeper about twice a second and says which answer it has seen last. The keeper counts its
lease from when it *gave* that answer, by its own clock; the launcher from when it *received* one, by its own. As an
answer is received after it was given, the keeper's lease always ends first, whatever the two clocks show and however
long a look was under way: one that a network delivers after a cut of minutes names an old answer and prolongs nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from apex_bat.roles.orders import ORPHANED_S

YOUNG_S, IMPORTS_S = 30.0, 5.0
"""How long ago a role may have been started that is still importing its libraries, and how long that may go on."""
MARGIN_S = 0.5
"""What the launcher waits beyond: for the keeper's kill to be done, and for clocks that run unequally fast."""


def clock_s() -> float:
    """Returns seconds that never go backwards and that go on while the machine sleeps, where the system counts those.

    `time.monotonic` stands still meanwhile. The launcher counts by that: its own sleep makes it wait the longer.
    """
    boot_time = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic() if boot_time is None else time.clock_gettime(boot_time)


class Lease:
    """The keeper's end."""

    def __init__(self, lease_s: float, clock: Callable[[], float]) -> None:
        """Begins now; `clock` gives seconds, never backwards."""
        self._lease_s, self._clock = lease_s, clock
        self._given_s = {0: clock()}
        self._ends_s = self._given_s[0] + lease_s
        self._number = 0

    def answer(self, seen: int) -> int:
        """Notes a look by which the launcher has seen answer `seen`; returns the number of the answer to it."""
        given_s = self._given_s.get(seen)
        if given_s is not None:
            self._ends_s = max(self._ends_s, given_s + self._lease_s)
        self._given_s = {number: at_s for number, at_s in self._given_s.items() if number >= seen}
        self._number += 1
        self._given_s[self._number] = self._clock()
        return self._number

    @property
    def has_lapsed(self) -> bool:
        """Whether it is over, until the launcher is heard again."""
        return self._clock() >= self._ends_s


class Hearing:
    """The launcher's end: what it knows of one keeper."""

    def __init__(self, lease_s: float) -> None:
        self.lease_s = lease_s
        self.seen = 0
        """Number of the newest answer."""
        self.heard_s: float | None = None
        """When it came; None before the first."""
        self.lost_s: float | None = None
        """When it was known that the keeper is gone; None while it is not."""
        self.ordered_s: float | None = None
        """When a role was last ordered to start there, even if the answer was an error; None: never."""

    def take(self, now_s: float, number: int | None = None) -> None:
        """Notes an answer: `number` if it is one to a look, None to another call, which prolongs no lease."""
        self.heard_s = now_s
        if number is not None:
            self.seen = number

    def silent_s(self, now_s: float) -> float:
        """Returns for how long the keeper has not been heard; 0 before its first answer."""
        return 0.0 if self.heard_s is None else now_s - self.heard_s

    def take_loss(self, now_s: float) -> None:
        """Notes that the keeper is gone."""
        if self.lost_s is None:
            self.lost_s = now_s

    def gone_s(self) -> float:
        """Returns from when on nothing runs there that was started by a keeper that is gone; infinite if it is not.

        A dead keeper enforces no lease. Its end is the end of its role's leash, which has ORPHANED_S for its last
        files; and the keeper may have died just before that was known. A young role hears of it after its imports.
        """
        if self.lost_s is None:
            return float("inf")
        if self.ordered_s is None:
            return self.lost_s
        is_young = self.lost_s - self.ordered_s < YOUNG_S
        return self.lost_s + ORPHANED_S + MARGIN_S + (IMPORTS_S if is_young else 0.0)

    def is_over(self, now_s: float) -> bool:
        """Whether the keeper's lease has ended for certain."""
        return self.heard_s is not None and now_s >= self.heard_s + self.lease_s + MARGIN_S
