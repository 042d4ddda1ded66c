"""Files of rerun that leave nothing in the process that writes them.

rerun keeps every recording and every blueprint that Python has let go, each with two threads and a megabyte or more
(its issue 2116, open): an evaluator would grow by gigabytes a day. What is here goes below rerun's public functions,
which the pinned version allows; a test counts threads.
"""

from __future__ import annotations

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings


def save(recording: rr.RecordingStream, path: Path, blueprint: rrb.Blueprint, application_id: str) -> None:
    """Begins the file of a recording, as `recording.save` does with a default blueprint, but lets the blueprint go.

    Raises:
        RuntimeError: of rerun, where the file cannot be made.
    """
    layout = rr.RecordingStream._from_native(
        rerun_bindings.new_blueprint(
            application_id=application_id, make_default=False, make_thread_default=False, default_enabled=True
        )
    )
    layout.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(layout)
    try:
        rerun_bindings.save(
            path=str(path),
            default_blueprint=layout.memory_recording().storage,
            recording=recording.to_native(),
            write_footer=True,
        )
    finally:
        layout.disconnect()  # its sink in memory and it refer to each other: nothing else parts them


def drop_orphans() -> None:
    """Ends the recordings that nobody refers to any more; call it after the last reference is gone.

    `rerun.init` does the same, but begins a recording of its own.
    """
    rerun_bindings.flush_and_cleanup_orphaned_recordings()
