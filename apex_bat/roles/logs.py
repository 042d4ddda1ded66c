"""Logs of bounded size that also catch what C code and crashes write.

The launcher opens a role's standard output and error onto its log, so that nothing is lost before Python runs. When the
log is renamed, both are moved to the new one: what faulthandler and C libraries write goes to the newest log always.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from logging.handlers import RotatingFileHandler
from pathlib import Path

from apex_bat.config.settings import Launch

LAUNCHER_LOG = "launcher"
_STANDARD = (1, 2)


class RotatingLog(RotatingFileHandler):
    """A log file that is renamed at a size; keeps standard output and error on the newest file if asked to.

    A line that cannot be written, on a full disk, is dropped without a word: there is nowhere to say it.
    """

    def __init__(self, path: Path, launch: Launch, *, takes_standard: bool = False) -> None:
        """Takes the file and the settings; `takes_standard`: whether file descriptors 1 and 2 follow the log."""
        self._takes_standard = takes_standard
        # An open file cannot be renamed on Windows, and descriptors 1 and 2 would hold it open.
        max_bytes = int(launch.log_max_mb * 1e6) if os.name == "posix" else 0
        super().__init__(path, maxBytes=max_bytes, backupCount=launch.log_files, encoding="utf-8", errors="replace")
        if takes_standard:
            self._move_standard()

    def doRollover(self) -> None:  # noqa: N802  # the library's name
        """Renames the log and begins a new one."""
        if self.backupCount == 0 and self.stream is not None:  # the library would go on appending for ever
            self.stream.truncate(0)
            return
        super().doRollover()
        if self._takes_standard:
            self._move_standard()

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  # the library's name
        """Drops a line that the disk does not take; anything else is a mistake of ours and is shown."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

    def _move_standard(self) -> None:
        if self.stream is None:
            return
        for descriptor in _STANDARD:
            with suppress(OSError):
                os.dup2(self.stream.fileno(), descriptor)


@contextmanager
def launcher_log(run: Path, launch: Launch) -> Iterator[None]:
    """Writes what the launcher says of its roles to `logs/launcher.log` too, while the block lasts."""
    handler = RotatingLog(run / "logs" / f"{LAUNCHER_LOG}.log", launch)
    handler.setFormatter(logging.Formatter(f"%(asctime)s {LAUNCHER_LOG} %(levelname)s %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        handler.close()
