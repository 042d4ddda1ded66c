"""One launcher a run folder, and no second one while anything that the first one started lives.

The lock is on the folder itself, so that no file is left behind; the kernel lets go of it when the last process that
holds it ends, however that ends. The roles inherit it: those of a killed launcher write their last files for some
seconds yet.
"""

from __future__ import annotations

import errno
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_LOOK_S = 0.1
_log = logging.getLogger(__name__)


class InUseError(RuntimeError):
    """Something of the run still lives."""


@contextmanager
def locked(run: Path, is_launched: Callable[[], bool] = lambda: False, patience_s: float = 0.0) -> Iterator[int | None]:
    """Locks a run folder while the block lasts.

    Args:
        run: the folder.
        is_launched: says whether the launcher that was there last still runs; then nobody waits for the lock.
        patience_s: how long to wait for the roles of one that does not.

    Yields:
        The file descriptor that holds the lock, for processes to inherit; None where folders cannot be locked: on
        Windows, and on some network drives.

    Raises:
        InUseError: it is locked, or its launcher runs.
    """
    if is_launched():
        raise InUseError(f"{run}: is still running; end it first, with Ctrl-C")
    if sys.platform == "win32":
        yield None
        return
    descriptor = os.open(run, os.O_RDONLY)
    try:
        yield descriptor if _lock(descriptor, run, time.monotonic() + patience_s) else None
    finally:
        os.close(descriptor)


def _lock(descriptor: int, run: Path, until_s: float) -> bool:
    """Locks; returns whether this file system can. Raises InUseError when it is still locked after the time."""
    if sys.platform == "win32":
        return False
    import fcntl

    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES):
                _log.warning("%s: cannot be locked (%s): start no second run in it", run, error.strerror)
                return False
            if time.monotonic() >= until_s:
                raise InUseError(f"{run}: is still in use; a launcher or a role of it has not ended yet") from None
            time.sleep(_LOOK_S)
        else:
            return True
