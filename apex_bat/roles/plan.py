"""Which roles a run has and where they find one another: data, without any way of starting them."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from threading import Event
from typing import Literal, NamedTuple

import numpy as np
from msgspec import Struct

from apex_bat.config import Config
from apex_bat.transport.security import Keys, load_keys

Kind = Literal["replay", "learner", "actor", "evaluator"]


class Addresses(Struct, frozen=True, forbid_unknown_fields=True):
    """ZeroMQ endpoints of a run."""

    replay: str
    """The replay server binds it; actors insert, the learner samples."""
    weights: str
    """The learner binds it and broadcasts; actors listen."""
    reports: str
    """The launcher binds it; every role reports."""


class Role(NamedTuple):
    """One process of a run."""

    kind: Kind
    number: int

    @property
    def name(self) -> str:
        """`replay`, `learner`, `evaluator`, or `actor-3`."""
        return f"actor-{self.number}" if self.kind == "actor" else self.kind


class Assignment(NamedTuple):
    """Everything a role is told: it does not know what kind of process it runs in."""

    role: Role
    config: Config
    run: Path
    """The run folder."""
    addresses: Addresses
    stop: Event
    """Set when the role is to end by itself."""
    incarnation: int
    """Counts the starts of this role in the run, from 0."""

    def generator(self) -> np.random.Generator:
        """Returns the role's own random stream, derived from the run's seed, its kind, number and incarnation."""
        kind = ("replay", "learner", "actor", "evaluator").index(self.role.kind)
        return np.random.default_rng([self.config.seed, kind, self.role.number, self.incarnation])

    def keys(self) -> Keys | None:
        """Returns the CURVE keys that the settings name; None without.

        Raises:
            TransportError: they are missing or others may read them.
        """
        folder = self.config.transport.keys
        return load_keys(Path(folder)) if folder else None

    @property
    def host(self) -> str:
        """Name of this machine."""
        return socket.gethostname()

    @property
    def pid(self) -> int:
        """Number of this process."""
        return os.getpid()


def roles_of(config: Config) -> list[Role]:
    """Returns the roles of a run in the order in which they start."""
    roles = [Role("replay", 0), Role("learner", 0), *(Role("actor", i) for i in range(config.actors))]
    if config.evaluation.during_training:
        roles.append(Role("evaluator", 0))
    return roles
