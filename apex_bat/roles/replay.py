"""The replay role: serves the central replay until told to stop."""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path

from apex_bat.replay.server import ReplayServer
from apex_bat.roles.plan import Assignment, Role
from apex_bat.roles.reporting import RoleReporter

_log = logging.getLogger(__name__)
_WAIT_S = 0.2


def snapshot_of(run: Path, role: Role) -> Path:
    """Returns where a replay server keeps its newest snapshot: `replay/replay.snapshot`, or `replay-0.snapshot`."""
    return run / "replay" / f"{role.name}.snapshot"


def run_replay(assignment: Assignment) -> None:
    """Serves until told to stop; restores the newest snapshot first and writes a last one."""
    path, number = snapshot_of(assignment.run, assignment.role), assignment.role.number
    address = assignment.addresses.replays[number]
    server = ReplayServer(
        assignment.config, address, assignment.generator(), path, keys=assignment.keys(),
        generation=assignment.addresses.replay_generations[number], life=assignment.incarnation,
    )  # fmt: skip
    reporter = RoleReporter(assignment, address)
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
