"""Removing what killed processes leave behind in a run folder: files that they had not finished."""

from __future__ import annotations

import logging
import os
import shutil
from contextlib import suppress
from pathlib import Path

import psutil

from apex_bat.replay.snapshot import WRITING, candidates
from apex_bat.storage import UNFINISHED, writer_of

_log = logging.getLogger(__name__)


def remove_leftovers(run: Path) -> list[Path]:
    """Removes unfinished files of processes that are gone, and returns them; no recordings: those can be repaired.

    The caller holds the lock of the run, so that no role of it lives; whoever else writes there, such as an evaluation,
    is known by the number in the name of its file. A snapshot of the replay that only lacks its name is kept.

    Args:
        run: the run folder.
    """
    found = [path for path in run.rglob(f".*{UNFINISHED}") if _is_left(path)]
    found += [path for path in run.glob(f"replay/*{WRITING}") if not is_needed(path)]
    for path in found:
        with suppress(OSError):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
    if found:
        _log.info("removed %d unfinished files of processes that are gone", len(found))
    return found


def is_needed(writing: Path) -> bool:
    """Whether an unfinished file is a snapshot from which the replay goes on: one that only lacks its name."""
    name = writing.name.removesuffix(WRITING)
    return name != writing.name and writing in candidates(writing.with_name(name))


def _is_left(path: Path) -> bool:
    """Whether nobody writes a file any more; this process, which is asking, does not."""
    writer = writer_of(path)
    return writer is None or writer == os.getpid() or not psutil.pid_exists(writer)
