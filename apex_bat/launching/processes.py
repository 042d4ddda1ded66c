"""Roles as subprocesses of the launcher, held by a leash.

The leash is the child's standard input: its end of file means "stop, or the launcher is gone", which the kernel
guarantees on every system, also when the launcher is killed. Each child is in a session of its own, so that Ctrl-C
reaches the launcher only.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from apex_bat.config import Config
from apex_bat.launching import ONE_THREAD
from apex_bat.launching.leftovers import is_needed
from apex_bat.launching.reserve import AFTER_S, Reserve
from apex_bat.launching.supervisor import Exit
from apex_bat.roles.orders import STOP, line_of_life
from apex_bat.roles.plan import Role

KILL_TIMEOUT_S = 2.0
"""How long a killed process is waited for. One that waits for a dead disk or network drive takes longer to go."""


class Recipe(NamedTuple):
    """What all processes of a role in a run have in common."""

    role: Role
    run: Path
    """The run folder; output is appended to `logs/NAME.log` there."""
    num_threads: int
    """Of numpy's linear algebra and of torch."""
    is_ordered: bool = False
    """Whether it is told addresses and keys on its standard input, see `roles.orders`; else it reads addresses.json."""
    lock: int | None = None
    """File descriptor of the run's lock, which the process keeps open as long as it lives."""
    folder: Path | None = None
    """To work in, where paths of the settings are relative to; None: that of this process."""

    @property
    def log(self) -> Path:
        """The role's log."""
        return self.run / "logs" / f"{self.role.name}.log"

    def start(self, *life: str) -> subprocess.Popen[bytes]:
        """Starts a process with options that say which life it is to begin.

        Raises:
            OSError: it cannot be started.
        """
        command = [sys.executable, "-m", "apex_bat", self.role.kind, "--run", str(self.run), "--leash",
                   "--number", str(self.role.number), *life, *(("--orders",) if self.is_ordered else ())]  # fmt: skip
        environment = os.environ | dict.fromkeys(ONE_THREAD, str(self.num_threads))
        flags = 0 if os.name == "posix" else subprocess.CREATE_NEW_PROCESS_GROUP  # type: ignore[attr-defined]
        with self.log.open("ab") as output:
            return subprocess.Popen(  # noqa: S603  # our own command
                command, stdin=subprocess.PIPE, stdout=output, stderr=output, env=environment,
                start_new_session=os.name == "posix", creationflags=flags,
                pass_fds=() if self.lock is None else (self.lock,), cwd=self.folder,
            )  # fmt: skip

    def reserve(self) -> Reserve:
        """Returns a reserve of the role's processes; none is started yet."""
        return Reserve(lambda: self.start("--reserve"))


class RoleProcess:
    """One role, running as `python -m apex_bat KIND`."""

    def __init__(
        self,
        recipe: Recipe,
        incarnation: int,
        flown_steps: int = 0,
        *,
        orders: bytes = b"",
        cleans: bool = True,
        reserve: Reserve | None = None,
    ) -> None:
        """Starts it, or lets one in reserve begin.

        Args:
            recipe: where from.
            incarnation: number of this life of the role.
            flown_steps: environment steps of the whole run so far.
            orders: the line that tells it addresses and keys, for one that is ordered.
            cleans: whether to remove, once it has ended, the files that it was writing.
            reserve: of processes of this role; None: each is started when it is needed.

        Raises:
            OSError: it cannot be started.
        """
        self._recipe, self._cleans, self._reserve = recipe, cleans, reserve
        self._begun_s = time.monotonic()
        prepared = None if reserve is None else reserve.take()
        if prepared is None:
            self._process = recipe.start("--incarnation", str(incarnation), "--flown", str(flown_steps))
        else:
            self._process = prepared
            self.tell(line_of_life(incarnation, flown_steps))
        if orders:
            self.tell(orders)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def waiting(self) -> str:
        """Nothing: it has its process."""
        return ""

    def tell(self, orders: bytes) -> None:
        """Writes a line of orders to a role that takes them; one that has ended does not hear it."""
        pipe = self._process.stdin
        with suppress(OSError, ValueError):  # closed by either end
            if pipe is not None:
                pipe.write(orders)
                pipe.flush()

    def poll(self) -> Exit | None:
        """Returns how it ended, with the last line of its log, or None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        self._clean()
        return Exit(code, last_line(self._recipe.log))

    def tend_reserve(self) -> None:
        """Has a process in reserve once this one has worked for a while."""
        if self._reserve is not None and time.monotonic() - self._begun_s > AFTER_S and self._process.poll() is None:
            self._reserve.tend()

    def stop(self) -> None:
        """Asks it to save and end, and lets its reserve go: there will be no other."""
        if self._reserve is not None:
            self._reserve.let_go()
        self._let_go()

    def _let_go(self) -> None:
        """Lets go of the leash."""
        if self._recipe.is_ordered:
            self.tell(STOP)
        if self._process.stdin is not None and not self._process.stdin.closed:
            with suppress(OSError):  # of orders that it did not read before it ended; the pipe is closed all the same
                self._process.stdin.close()

    def kill(self) -> None:
        """Ends it at once and waits for it, for a moment; whether it is gone `poll` says."""
        self._let_go()
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(KILL_TIMEOUT_S)
            self._clean()

    def _clean(self) -> None:
        if self._cleans:
            remove_unfinished(self._recipe.run, self._recipe.role, self.pid)


def threads_of(role: Role, config: Config) -> int:
    """Returns how many threads a role may use for linear algebra."""
    return config.train.threads if role.kind == "learner" else 1


def has_reserve(role: Role, config: Config) -> bool:
    """Whether a process waits to take the place of a role: of the learner, which imports torch."""
    return role.kind == "learner" and config.launch.learner_in_reserve


def remove_unfinished(run: Path, role: Role, pid: int) -> None:
    """Removes the files that a process was writing when it ended, but none that is whole and only lacks its name.

    No recordings: those can be opened and repaired.
    """
    patterns = [f"checkpoints/.*.{pid}.part"]
    own = {"replay": [f"replay/{role.name}.snapshot.writing"], "evaluator": ["checkpoints/.best.part"]}
    patterns += own.get(role.kind, [])
    for path in (path for pattern in patterns for path in run.glob(pattern)):
        if not is_needed(path):
            with suppress(OSError):
                path.unlink()


def last_line(path: Path, tail_bytes: int = 8192) -> str:
    """Returns the message of a log's last line, without its time and level; empty if there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - tail_bytes))
            lines = file.read().decode("utf-8", "replace").split("\n")
    except OSError:
        return ""
    text = next((line for line in reversed(lines) if line.strip()), "")
    return text.partition(" ERROR ")[2] or text.strip()
