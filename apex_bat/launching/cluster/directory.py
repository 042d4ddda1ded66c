"""Who listens where in a run on a cluster: endpoints that move, each with a generation of its own."""

from __future__ import annotations

import secrets
from typing import NamedTuple

from apex_bat.roles.plan import Addresses, Role


class _Server(NamedTuple):
    endpoint: str
    generation: int


class Directory:
    """The newest endpoint of each server.

    Every life of a server has another generation: what a life on a node that was cut off still says is refused, and so
    is what still goes to it.

    Attributes:
        version: grows with each change.
    """

    def __init__(self, reports: str, num_replays: int) -> None:
        """Knows no server yet.

        Args:
            reports: where the launcher listens, which does not move.
            num_replays: servers that share the replay.
        """
        self._reports = reports
        self._replays: list[_Server | None] = [None] * num_replays
        self._weights: _Server | None = None
        self.version = 0

    def settle(self, role: Role, endpoint: str) -> None:
        """Notes where a new life of a replay server or of the learner will listen; others listen nowhere."""
        server = _Server(endpoint, new_generation())
        if role.kind == "replay":
            self._replays[role.number] = server
        elif role.kind == "learner":
            self._weights = server
        else:
            return
        self.version += 1

    def addresses_for(self, role: Role, reports_generation: int) -> Addresses | None:
        """Returns what a role is told, or None while a server that it needs has no place yet.

        Args:
            role: which.
            reports_generation: that of this life of it.
        """
        needed = [self._replays[role.number]] if role.kind == "replay" else [*self._replays, self._weights]
        if None in needed and role.kind != "evaluator":
            return None
        first, *further = [server or _Server("", 0) for server in self._replays]
        weights = self._weights or _Server("", 0)
        return Addresses(
            first.endpoint, weights.endpoint, self._reports, replay_generation=first.generation,
            weights_generation=weights.generation, reports_generation=reports_generation,
            further_replays=tuple((server.endpoint, server.generation) for server in further),
        )  # fmt: skip


def new_generation() -> int:
    """Returns a number that nobody can guess."""
    return secrets.randbits(63)
