"""CPU seconds and memory of a process with everything that it started, also what outlived its parent.

Memory is the proportional set size where the system tells it: what several processes share is counted once. A process
that lives for less than the time between two looks may be missed.
"""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import psutil

_PSS = b"Pss:"


class Sample(NamedTuple):
    """What the processes have used up to one moment."""

    wall_s: float
    cpu_s: float
    memory_mb: float


class ProcessTree:
    """Watches the process of one command and its descendants."""

    def __init__(self, pid: int) -> None:
        self._known: dict[tuple[int, float], psutil.Process] = {}
        self._cpu_s: dict[tuple[int, float], float] = {}
        self.samples: list[Sample] = []
        self._take(psutil.Process(pid))

    def look(self, wall_s: float) -> Sample:
        """Finds new descendants, adds up, and keeps and returns the sum."""
        self._find()
        memory_mb = 0.0
        for key, process in list(self._known.items()):
            try:
                times = process.cpu_times()
                self._cpu_s[key] = times.user + times.system
                memory_mb += _memory_mb(process)
            except psutil.Error:
                del self._known[key]
        self.samples.append(Sample(wall_s, sum(self._cpu_s.values()), memory_mb))
        return self.samples[-1]

    def end(self, grace_s: float) -> None:
        """Asks what is left to end, and kills it after the grace."""
        for process in self._living():
            with suppress(psutil.Error):
                process.terminate()
        deadline_s = time.monotonic() + grace_s
        while self._living() and time.monotonic() < deadline_s:
            time.sleep(0.1)
        for process in self._living():
            with suppress(psutil.Error):
                process.kill()

    def _find(self) -> None:
        """Takes up new descendants, in one pass over all processes of the machine: psutil's own way takes one each."""
        children: dict[int, list[psutil.Process]] = {}
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                children.setdefault(process.ppid(), []).append(process)
        waiting = [pid for pid, _ in self._known]
        while waiting:
            for child in children.pop(waiting.pop(), ()):
                self._take(child)
                waiting.append(child.pid)

    def _take(self, process: psutil.Process) -> None:
        with suppress(psutil.Error):
            self._known.setdefault((process.pid, process.create_time()), process)

    def _living(self) -> list[psutil.Process]:
        living = []
        for process in self._known.values():
            with suppress(psutil.Error):
                if process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                    living.append(process)
        return living


def _memory_mb(process: psutil.Process) -> float:
    """Returns the proportional set size in MB of 1e6 bytes, or the resident size where there is no such thing."""
    try:
        for line in Path(f"/proc/{process.pid}/smaps_rollup").read_bytes().splitlines():
            if line.startswith(_PSS):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    return float(process.memory_info().rss) / 1e6
