"""The replay role: serves the central replay until told to stop, with snapshots in between."""

from __future__ import annotations

import logging
import time

from apex_bat.replay.server import ReplayServer
from apex_bat.roles.plan import Assignment
from apex_bat.roles.reporting import RoleReporter
from apex_bat.storage import StorageError

SNAPSHOT = "replay.npz"
_log = logging.getLogger(__name__)
_WAIT_S = 0.2


def run_replay(assignment: Assignment) -> None:
    """Serves until told to stop; restores the newest snapshot first and writes a last one."""
    config = assignment.config
    path = assignment.run / "replay" / SNAPSHOT
    server = ReplayServer(config, assignment.addresses.replay, assignment.generator(), path)
    reporter = RoleReporter(assignment, assignment.addresses.replay)
    due_s = time.monotonic() + config.replay.snapshot_period_s
    try:
        if path.exists():
            server.restore()
            _log.info("continues from the snapshot %s", path)
        while not assignment.stop.is_set():
            server.serve(_WAIT_S)
            if reporter.is_due:
                for name, value in server.metrics().items():
                    reporter.gauge(name, value)
                reporter.send(server.state())
            if config.replay.snapshot_period_s > 0.0 and time.monotonic() >= due_s:
                _try_save(server)
                due_s = time.monotonic() + config.replay.snapshot_period_s
        _try_save(server)
    finally:
        server.close()
        reporter.close()


def _try_save(server: ReplayServer) -> None:
    try:
        server.save()
    except StorageError as error:
        _log.error("no snapshot: %s; the replay goes on without", error)
