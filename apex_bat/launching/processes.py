"""Roles as subprocesses of the launcher, held by a leash.

The leash is the child's standard input: its end of file means "stop, or the launcher is gone", which the kernel
guarantees on every system, also when the launcher is killed. Each child is in a session of its own, so that Ctrl-C
reaches the launcher only.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from apex_bat.config import Config
from apex_bat.launching import ONE_THREAD
from apex_bat.launching.leftovers import is_needed
from apex_bat.launching.supervisor import Exit
from apex_bat.roles.orders import STOP
from apex_bat.roles.plan import Role

KILL_TIMEOUT_S = 2.0
"""How long a killed process is waited for. One that waits for a dead disk or network drive takes longer to go."""


class RoleProcess:
    """One role, running as `python -m apex_bat KIND`."""

    def __init__(
        self,
        role: Role,
        run: Path,
        incarnation: int,
        num_threads: int,
        flown_steps: int = 0,
        lock: int | None = None,
        *,
        orders: bytes | None = None,
        folder: Path | None = None,
        cleans: bool = True,
    ) -> None:
        """Starts it; its output is appended to `logs/NAME.log`.

        Args:
            role: which.
            run: the run folder.
            incarnation: number of this life of the role.
            num_threads: of numpy's linear algebra and of torch.
            flown_steps: environment steps of the whole run so far.
            lock: file descriptor of the run's lock, which the process keeps open as long as it lives.
            orders: the line that tells it addresses and keys, see `roles.orders`; None: it reads addresses.json.
            folder: to work in, where paths of the settings are relative to; None: that of this process.
            cleans: whether to remove, once it has ended, the files that it was writing.

        Raises:
            OSError: it cannot be started.
        """
        self._role, self._run, self._cleans, self._is_ordered = role, run, cleans, orders is not None
        self._log = run / "logs" / f"{role.name}.log"
        command = [sys.executable, "-m", "apex_bat", role.kind, "--run", str(run), "--leash",
                   "--number", str(role.number), "--incarnation", str(incarnation),
                   "--flown", str(flown_steps), *(("--orders",) if orders is not None else ())]  # fmt: skip
        environment = os.environ | dict.fromkeys(ONE_THREAD, str(num_threads))
        flags = 0 if os.name == "posix" else subprocess.CREATE_NEW_PROCESS_GROUP  # type: ignore[attr-defined]
        with self._log.open("ab") as output:
            self._process = subprocess.Popen(  # noqa: S603  # our own command
                command, stdin=subprocess.PIPE, stdout=output, stderr=output, env=environment,
                start_new_session=os.name == "posix", creationflags=flags,
                pass_fds=() if lock is None else (lock,), cwd=folder,
            )  # fmt: skip
        if orders is not None:
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
        return Exit(code, last_line(self._log))

    def stop(self) -> None:
        """Asks it to save and end: lets go of the leash."""
        if self._is_ordered:
            self.tell(STOP)
        if self._process.stdin is not None and not self._process.stdin.closed:
            with suppress(OSError):  # of orders that it did not read before it ended; the pipe is closed all the same
                self._process.stdin.close()

    def kill(self) -> None:
        """Ends it at once and waits for it, for a moment; whether it is gone `poll` says."""
        self.stop()
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(KILL_TIMEOUT_S)
            self._clean()

    def _clean(self) -> None:
        if self._cleans:
            remove_unfinished(self._run, self._role, self.pid)


def threads_of(role: Role, config: Config) -> int:
    """Returns how many threads a role may use for linear algebra."""
    return config.train.threads if role.kind == "learner" else 1


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
