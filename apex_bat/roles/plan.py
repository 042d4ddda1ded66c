"""Which roles a run has and where they find one another: data, without any way of starting them."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Struct

from apex_bat.config import Config
from apex_bat.storage import StorageError, read_json
from apex_bat.transport.security import Keys, load_keys

Kind = Literal["replay", "learner", "actor", "evaluator"]


_LIVES_OF_A_PART = 1_000_000  # at one restart each 30 s, the longest backoff, a year

Generation = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class Endpoints(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the sockets of a run listen."""

    replay: str
    """The replay server binds it; actors insert, the learner samples."""
    weights: str
    """The learner binds it and broadcasts; actors listen."""
    reports: str
    """The launcher binds it; every role reports."""


class Addresses(Endpoints, frozen=True, kw_only=True):
    """ZeroMQ endpoints of a run and the generation of each."""

    replay_generation: Generation = 0
    """What every message to and from the replay server repeats. Drawn anew for each start, so that what is left of a
    former one is refused, and so is a stranger on this machine, who cannot read it: the file has mode 0600."""
    weights_generation: Generation = 0
    """The same for the weights; another number, because whoever may listen to them learns it."""
    reports_generation: Generation = 0
    """The same for reports."""
    further_replays: tuple[tuple[str, Generation], ...] = ()
    """Address and generation of the replay servers beyond the first, where several share the transitions."""

    @property
    def replays(self) -> list[str]:
        """Addresses of all replay servers, by their numbers."""
        return [self.replay, *(address for address, _ in self.further_replays)]

    @property
    def replay_generations(self) -> list[int]:
        """Their generations."""
        return [self.replay_generation, *(generation for _, generation in self.further_replays)]


class Role(NamedTuple):
    """One process of a run."""

    kind: Kind
    number: int
    of: int = 1
    """How many of its kind the run has; told of replay servers only."""

    @property
    def name(self) -> str:
        """`replay`, `learner`, `evaluator`, or `actor-3`; `replay-0` where several replay servers share the work."""
        return f"{self.kind}-{self.number}" if self.kind == "actor" or self.of > 1 else self.kind


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
    """Differs for each start of this role in the run, also after the run was resumed: see `incarnation_of`."""
    flown_steps: int = 0
    """Environment steps of the whole run when this role was started, for what runs over the steps of all bats."""
    clock: Callable[[], float] = time.monotonic
    """Seconds, never backwards: what periods are measured by. The serial mode has one of simulated time."""
    moved: Callable[[], Addresses | None] = lambda: None
    """Returns the addresses anew, once, when a server of the run listens elsewhere; else None."""
    given_keys: Keys | None = None
    """CURVE keys that the launcher has handed over; None: those of the folder that the settings name, if any."""

    def generator(self) -> np.random.Generator:
        """Returns the role's own random stream, derived from the run's seed, its kind, number and incarnation."""
        kind = ("replay", "learner", "actor", "evaluator").index(self.role.kind)
        return np.random.default_rng([self.config.seed, kind, self.role.number, self.incarnation])

    def keys(self) -> Keys | None:
        """Returns the CURVE keys of the run: those given, or those that the settings name; None without.

        Raises:
            TransportError: they are missing or others may read them.
        """
        if self.given_keys is not None:
            return self.given_keys
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


def incarnation_of(part: int, restarts: int) -> int:
    """Returns the number of a life of a role, which no other life of it has had.

    Args:
        part: how often the run was resumed before. Counted apart, because a killed launcher may not have noted the
            last restarts.
        restarts: how often the role was started before since the run was started or resumed.
    """
    return part * _LIVES_OF_A_PART + restarts


def role_of(kind: Kind, number: int, config: Config) -> Role:
    """Returns a role of a run by its number."""
    return Role(kind, number, config.replay.shards) if kind == "replay" else Role(kind, number)


def roles_of(config: Config) -> list[Role]:
    """Returns the roles of a run in the order in which they start."""
    replays = [role_of("replay", i, config) for i in range(config.replay.shards)]
    roles = [*replays, Role("learner", 0), *(Role("actor", i) for i in range(config.actors))]
    if config.evaluation.during_training:
        roles.append(Role("evaluator", 0))
    return roles


def read_addresses(path: Path) -> Addresses:
    """Returns the addresses that a launcher wrote.

    Raises:
        StorageError: the file is missing or damaged.
    """
    try:
        return msgspec.convert(read_json(path), Addresses)
    except msgspec.ValidationError as error:
        raise StorageError(f"{path}: torn or corrupted: {error}") from None
