"""What keeps one role on a host of a cluster: starts its process, looks after it, ends it when the lease lapses.

A keeper knows nothing of Ray; `ray_keepers` runs one in each Ray actor. The role is a process of its own beneath it, as
on one machine: it has its own main thread, log, number of threads and exit code, and it ends when the keeper is gone.
"""

from __future__ import annotations

import logging
import os
import platform
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import apex_bat
from apex_bat.launching.cluster.lease import Lease, clock_s
from apex_bat.launching.processes import Recipe, RoleProcess
from apex_bat.launching.reserve import Reserve
from apex_bat.roles.plan import Role

LOOK_S = 0.1
"""Between two looks at the lease."""
MARK = ".same-folder"
"""File in the run folder by which a keeper tells that its host sees the launcher's folder."""
PATIENCE_S = 5.0
"""How long a keeper waits for the mark: network drives show new files late."""
NUM_PORTS = 100
"""Ports from `transport.base_port` on that may be taken."""
_log = logging.getLogger(__name__)


class Site(NamedTuple):
    """Where a keeper is."""

    host: str
    """Name of the machine."""
    address: str
    """IP address at which the other nodes reach it."""
    port: int
    """A TCP port that is free there now; 0 for a role that listens nowhere."""
    problem: str
    """Why no role can be started there; empty if one can."""
    node: str = ""
    """The host, as the cluster's own scheduler calls it; empty if there is none."""


class Look(NamedTuple):
    """A keeper's answer to a look."""

    number: int
    """Of the answer, see `lease`."""
    life: int
    """Number of the process that the rest is about, as `Keeper.start` was told; -1 before the first."""
    pid: int
    has_ended: bool
    code: int
    """Exit code, once it has ended."""
    detail: str
    """Last line of its log."""


class Keeper:
    """Keeps one role."""

    def __init__(
        self,
        run: str,
        mark: str,
        folder: str,
        lease_s: float,
        address: str,
        base_port: int = 0,
        node: str = "",
        clock: Callable[[], float] = clock_s,
    ) -> None:
        """Begins its lease; starts nothing yet.

        Args:
            run: path of the run folder.
            mark: what the file MARK in it holds.
            folder: where the launcher works, for settings that are relative paths; taken where it exists.
            lease_s: see `lease`.
            address: IP address of this host.
            base_port: first of the ports that servers may take; 0: any.
            node: see `Site`.
            clock: seconds, never backwards.
        """
        self._run, self._mark, self._address, self._base_port = Path(run), mark, address, base_port
        self._node = node
        self._folder = Path(folder) if Path(folder).is_dir() else None
        self._process: RoleProcess | None = None
        self._reserve: Reserve | None = None
        self._life = -1
        self._has_lapsed = False
        self._lease = Lease(lease_s, clock)
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._watch_lease, name="lease", daemon=True)
        self._thread.start()

    def site(self, versions: tuple[str, str], role: Role) -> Site:
        """Returns where this is, with a port that is free now.

        Args:
            versions: what `versions_here` returned to the launcher.
            role: that is to be started here.

        Raises:
            OSError: no port is free.
        """
        problem = "" if versions == versions_here() else f"versions differ: {versions_here()} here, {versions} there"
        problem = problem or self._foreign_folder()
        listens = role.kind in ("replay", "learner")
        port = free_port(self._address, self._base_port, first_port(role)) if listens and not problem else 0
        return Site(socket.gethostname(), self._address, port, problem, self._node)

    def prepare(self, role: Role, num_threads: int) -> None:
        """Lets a process in reserve import what the role needs, while it may not begin here yet."""
        if self._reserve is None:
            _show_package_to_children()
            self._reserve = self._recipe(role, num_threads).reserve()
            self._reserve.tend()

    def start(
        self, life: int, role: Role, incarnation: int, num_threads: int, flown_steps: int, orders: bytes,
        has_reserve: bool = False,
    ) -> int:  # fmt: skip
        """Starts the role and returns its pid; 0: nothing was started, because the lease has lapsed.

        A former process is killed first. A start that was long under way comes when the role has a place elsewhere.

        Args:
            life: number by which answers name this process.
            role: which.
            incarnation: see `plan.incarnation_of`.
            num_threads: of linear algebra.
            flown_steps: environment steps of the whole run so far.
            orders: first line on its standard input.
            has_reserve: whether a process is to wait here to take its place.

        Raises:
            OSError: it cannot be started.
        """
        if self._process is not None:
            self._process.kill()
        if self._lease.has_lapsed:
            return 0
        _show_package_to_children()
        recipe = self._recipe(role, num_threads)
        if has_reserve and self._reserve is None:
            self._reserve = recipe.reserve()
        self._process = RoleProcess(
            recipe, incarnation, flown_steps, orders=orders, reserve=self._reserve,
            cleans=False,  # this may come when the role works elsewhere, and the folder is the same
        )  # fmt: skip
        self._life, self._has_lapsed = life, False
        return self._process.pid

    def look(self, seen: int, orders: bytes | None = None) -> Look:
        """Prolongs the lease and returns how the role is.

        Args:
            seen: number of the newest answer that the launcher has seen.
            orders: a line for the role, if there is news.
        """
        number = self._lease.answer(seen)
        process = self._process
        if process is None:
            return Look(number, self._life, 0, False, 0, "")
        if orders is not None:
            process.tell(orders)
        ended = process.poll()
        if ended is None:
            process.tend_reserve()
            return Look(number, self._life, process.pid, False, 0, "")
        detail = "its host had not heard the launcher for the lease" if self._has_lapsed else ended.detail
        return Look(number, self._life, process.pid, True, ended.code or 0, detail)

    def stop(self) -> None:
        """Asks the role to end; it is not started again here."""
        if self._process is not None:
            self._process.stop()

    def kill(self) -> None:
        """Ends the role at once."""
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Ends the role and the watch over the lease."""
        self._is_closed.set()
        self._thread.join()
        self.kill()
        if self._reserve is not None:
            self._reserve.close()

    def _recipe(self, role: Role, num_threads: int) -> Recipe:
        return Recipe(role, self._run, num_threads, is_ordered=True, folder=self._folder)

    def _watch_lease(self) -> None:
        """Kills the role when the lease lapses.

        One that is told to end would write its last files beside those of its replacement.
        """
        while not self._is_closed.wait(LOOK_S):
            try:
                process = self._process
                if process is not None and self._lease.has_lapsed and process.poll() is None:
                    self._has_lapsed = True
                    process.kill()
            except Exception:  # whatever it is: without this thread the role would outlive its lease
                _log.exception("lease: looks again")

    def _foreign_folder(self) -> str:
        """Returns a complaint if this host does not see the launcher's run folder, else an empty text."""
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                if (self._run / MARK).read_text() == self._mark:
                    return ""
                reason = "another folder of that name"
            except OSError as error:
                reason = error.strerror or str(error)
            if time.monotonic() >= until_s:
                return (
                    f"{self._run}: not the launcher's run folder ({reason}); "
                    "give --run a folder that all nodes share under one path"
                )
            time.sleep(LOOK_S)


def versions_here() -> tuple[str, str]:
    """Returns the versions that launcher and keepers must share: of this package, and of Python without its patch."""
    return apex_bat.__version__, ".".join(platform.python_version_tuple()[:2])


def first_port(role: Role) -> int:
    """Returns which of the ports from `transport.base_port` on a server tries first.

    Each its own, or two servers that look for one on the same host at the same time would find the same. The launcher
    begins with the first of all.
    """
    return NUM_PORTS // 3 if role.kind == "learner" else 2 * NUM_PORTS // 3 + role.number


def free_port(address: str, base_port: int = 0, first: int = 0) -> int:
    """Returns a TCP port that is free now. Another process could take it before it is bound.

    Args:
        address: where to listen.
        base_port: first of the NUM_PORTS ports that are allowed; 0: any port.
        first: which of these is tried first; after the last comes the first.

    Raises:
        OSError: none is free.
    """
    for port in [base_port + (first + i) % NUM_PORTS for i in range(NUM_PORTS)] if base_port else (0,):
        with socket.socket() as one:
            try:
                one.bind((address, port))
            except OSError:
                continue
            return int(one.getsockname()[1])
    last_port = base_port + NUM_PORTS - 1
    raise OSError(f"{address}: none of the ports {base_port} to {last_port} is free; set transport.base_port")


def _show_package_to_children() -> None:
    """Lets `python -m apex_bat` find the package that this process has, wherever it came from."""
    folder = str(Path(apex_bat.__file__).parents[1])
    known = os.environ.get("PYTHONPATH", "")
    if folder not in known.split(os.pathsep) and folder in sys.path:
        os.environ["PYTHONPATH"] = os.pathsep.join([folder, *([known] if known else [])])
