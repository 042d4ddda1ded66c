"""Roles as subprocesses of the launcher, held by a leash.

The leash is the child's standard input: its end of file means "stop, or the launcher is gone", which the kernel
guarantees on every system, also when the launcher is killed. Each child is in a session of its own, so that Ctrl-C
reaches the launcher only.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from apex_bat.launching import ONE_THREAD
from apex_bat.launching.supervisor import Exit
from apex_bat.roles.plan import Role


class RoleProcess:
    """One role, running as `python -m apex_bat KIND`."""

    def __init__(self, role: Role, run: Path, incarnation: int, num_threads: int) -> None:
        """Starts it; its output is appended to `logs/NAME.log`."""
        self._log = run / "logs" / f"{role.name}.log"
        command = [sys.executable, "-m", "apex_bat", role.kind, "--run", str(run), "--leash",
                   "--number", str(role.number), "--incarnation", str(incarnation)]  # fmt: skip
        environment = os.environ | dict.fromkeys(ONE_THREAD, str(num_threads))
        flags = 0 if os.name == "posix" else subprocess.CREATE_NEW_PROCESS_GROUP  # type: ignore[attr-defined]
        with self._log.open("ab") as output:
            self._process = subprocess.Popen(  # noqa: S603  # our own command
                command, stdin=subprocess.PIPE, stdout=output, stderr=output, env=environment,
                start_new_session=os.name == "posix", creationflags=flags,
            )  # fmt: skip

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def poll(self) -> Exit | None:
        """Returns how it ended, with the last line of its log, or None while it runs."""
        code = self._process.poll()
        return None if code is None else Exit(code, last_line(self._log))

    def stop(self) -> None:
        """Lets go of the leash."""
        if self._process.stdin is not None and not self._process.stdin.closed:
            self._process.stdin.close()

    def kill(self) -> None:
        """Ends it at once and waits for it."""
        self.stop()
        self._process.kill()
        self._process.wait()


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
