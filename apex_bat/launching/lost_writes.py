"""What a full disk costs a run: the run goes on without what could not be written, and says so once a minute."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from apex_bat.storage import StorageError

COMPLAINT_PERIOD_S = 60.0
_log = logging.getLogger(__name__)


class LostWrites:
    """Counts the files and rows of a run that its disk did not take."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Takes the clock by which complaints are a minute apart, in seconds."""
        self._clock = clock
        self._complaint_due_s = float("-inf")
        self.number = 0

    @contextmanager
    def borne(self) -> Iterator[None]:
        """Lets the run go on when the disk does not take what the block writes; whoever wrote it tries again."""
        try:
            yield
        except StorageError as error:
            self.number += 1
            now_s = self._clock()
            if now_s >= self._complaint_due_s:
                self._complaint_due_s = now_s + COMPLAINT_PERIOD_S
                _log.error("%s; training goes on, and %d writes were lost so far", error, self.number)
