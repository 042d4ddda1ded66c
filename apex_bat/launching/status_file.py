"""Writing status.json: what a launcher, of processes or of the serial mode, says of its run for `status` to read."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path

from apex_bat.launching.standing import Standing
from apex_bat.launching.status import STATUS
from apex_bat.launching.supervisor import Watched
from apex_bat.roles.resources import birth_of, own_resources
from apex_bat.storage import write_text

STATUS_PERIOD_S = 1.0


class StatusFile:
    """The status of one run, written by the launcher that makes this object."""

    def __init__(self, run: Path) -> None:
        self._path = run / STATUS
        self._birth = birth_of(os.getpid())

    def write(
        self,
        standing: Standing,
        watched: dict[str, Watched],
        *,
        has_ended: bool,
        refused_reports: Mapping[str, int] | None = None,
    ) -> None:
        """Writes how a run stands now.

        Args:
            standing: what the reports of the roles add up to.
            watched: the roles and their processes.
            has_ended: whether this is the last time.
            refused_reports: how many reports were refused, by reason.

        Raises:
            StorageError: it cannot be written; the one before is untouched.
        """
        content = {
            "launcher_pid": os.getpid(), "launcher_birth": self._birth, "host": socket.gethostname(),
            "written_unix_s": time.time(), "ended": has_ended, "stall": standing.stall,
            "launcher_metrics": own_resources(), "refused_reports": dict(refused_reports or {}),
            "progress": standing.progress(), "roles": standing.status(watched),
        }  # fmt: skip
        write_text(self._path, json.dumps(content, indent=1))
