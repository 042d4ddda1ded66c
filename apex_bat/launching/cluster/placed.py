"""One life of a role on a cluster, as the supervisor sees it: placed, started, heard, ended or lost."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from typing import Literal

from apex_bat.config import Config
from apex_bat.launching.cluster.keeper import Look, Site
from apex_bat.launching.cluster.lease import Hearing
from apex_bat.launching.supervisor import TEMPORARY, USELESS, Exit
from apex_bat.roles.plan import Role

_KILLED = -int(getattr(signal, "SIGKILL", 9))
Order = Literal["stop", "kill"]


class Placed:
    """A life of a role; the fleet tells it what comes, the supervisor asks."""

    def __init__(
        self,
        role: Role,
        life: int,
        asks: str,
        config: Config,
        hearing: Hearing,
        order: Callable[[Order], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begins without a place.

        Args:
            role: which.
            life: number of it among all lives of all roles.
            asks: what it asks of the cluster, for whoever wonders why it waits.
            config: the settings.
            hearing: what is heard of its keeper.
            order: passes an order on to the keeper.
            clock: seconds, never backwards.
        """
        self.role, self.life = role, life
        self.pid = 0
        self.waiting = f"waiting for a place in the cluster: asks {asks}"
        self._config, self._hearing, self._order, self._clock = config, hearing, order, clock
        self._exit: Exit | None = None
        self._lost = ""
        self._host = "?"
        self._is_started = False

    def take_site(self, site: Site) -> bool:
        """Notes its place; returns whether it can be started there."""
        self._host = site.host
        self.waiting = "waiting for the places of replay and learner"
        if site.problem:
            self._exit = Exit(USELESS, f"{self.role.name} on {site.host}: {site.problem}")
        return not site.problem

    def take_useless(self, site: Site) -> None:
        """Notes a place where it cannot be started, which is not worth the end of the run: it waits there."""
        self._host = site.host
        self.waiting = f"not started on {site.host}: {site.problem}"

    def begin(self) -> None:
        """Notes that the order to start it has gone."""
        self._is_started, self._hearing.ordered_s, self.waiting = True, self._clock(), ""

    def take_start(self, pid: int) -> None:
        """Notes its process; 0: the keeper had not heard us for too long to start one."""
        self.pid = pid
        if not pid:
            self._exit = Exit(_KILLED, f"{self._host} had not heard the launcher", is_lost=True)

    def take_look(self, look: Look) -> None:
        """Notes what the keeper saw."""
        if look.life == self.life and self._exit is None:
            self.pid = look.pid
            if look.has_ended:
                self._exit = Exit(look.code, look.detail)

    def take_error(self, error: Exception) -> None:
        """Notes that the process could not be started.

        An OSError without a number, or with one of those that pass by themselves, is no failure of the role.
        """
        passes = isinstance(error, OSError) and (error.errno is None or error.errno in TEMPORARY)
        text = (error.strerror if isinstance(error, OSError) else None) or str(error)
        self._exit = Exit(None if passes else 1, f"on {self._host}: {text}")

    def take_loss(self, detail: str) -> None:
        """Notes that its keeper is gone."""
        self._lost = self._lost or detail
        self._hearing.take_loss(self._clock())

    @property
    def is_lost(self) -> bool:
        """Whether its keeper is gone; what was started on it may still be ending."""
        return bool(self._lost)

    @property
    def can_begin(self) -> bool:
        """Whether it waits for nothing but a place, and for those of replay and learner."""
        return bool(self.waiting) and not (self.is_lost or self.is_over)

    @property
    def is_over(self) -> bool:
        """Whether it has ended or is given up."""
        return self.poll() is not None

    def poll(self) -> Exit | None:
        """Returns how it ended; None while it runs, or may still run on a host that is not heard."""
        if self._exit is not None:
            return self._exit
        heard_s = self._hearing.heard_s
        if self._lost and heard_s is None:  # it never worked: what is wrong may well be wrong everywhere
            self._exit = Exit(1, self._lost)
        elif self._lost:  # then the lease says nothing: nobody is there to enforce it
            if self._is_gone_for_certain():
                self._exit = Exit(_KILLED, f"{self._host}: {self._lost}", is_lost=True)
        elif self._hearing.is_over(self._clock()):
            lease_s = self._config.cluster.lease_s
            self._exit = Exit(_KILLED, f"{self._host}: not heard for {lease_s:g} s", is_lost=True)
        return self._exit

    def stop(self) -> None:
        """Asks it to end; one that has not begun has ended."""
        if self._is_started:
            self._order("stop")
        elif self._exit is None:
            self._exit = Exit(0, "")

    def kill(self) -> None:
        """Ends it at once, if its host hears us; else when its lease ends."""
        if self._is_started:
            self._order("kill")
        elif self._exit is None:
            self._exit = Exit(_KILLED, "")

    def _is_gone_for_certain(self) -> bool:
        """Whether all that was started on its lost keeper has ended, although nobody could say so.

        The last files of that must not meet those of the replacement. Actors write nothing that counts.
        """
        return self.role.kind == "actor" or self._clock() >= self._hearing.gone_s()
