"""The replay role: serves the central replay until told to stop."""

from __future__ import annotations

import logging
from contextlib import suppress

from apex_bat.replay.server import ReplayServer
from apex_bat.roles.plan import Assignment
from apex_bat.roles.reporting import RoleReporter

SNAPSHOT = "replay.snapshot"
_log = logging.getLogger(__name__)
_WAIT_S = 0.2


def run_replay(assignment: Assignment) -> None:
    """Serves until told to stop; restores the newest snapshot first and writes a last one."""
    path = assignment.run / "replay" / SNAPSHOT
    server = ReplayServer(
        assignment.config, assignment.addresses.replay, assignment.generator(), path, keys=assignment.keys(),
        generation=assignment.addresses.replay_generation,
    )  # fmt: skip
    reporter = RoleReporter(assignment, assignment.addresses.replay)
    try:
        with suppress(FileNotFoundError):
            _log.info("continues: %s", server.restore())
        while not assignment.stop.is_set():
            server.serve(_WAIT_S)
            if reporter.is_due:
                _report(server, reporter, server.state())
        _report(server, reporter, "writing the last snapshot")
        try:
            server.save()
        except OSError as error:
            _log.error("no last snapshot: %s", error)
    finally:
        server.close()
        reporter.close()


def _report(server: ReplayServer, reporter: RoleReporter, state: str) -> None:
    for name, value in server.metrics().items():
        reporter.gauge(name, value)
    reporter.send(state)
