"""Training on a Ray cluster: the same roles, watched by the same supervisor, in places that Ray finds.

Ray does two things: it finds places, and it carries the calls to a keeper in each of them. Experience, batches, weights
and reports go by ZeroMQ as on one machine.
"""

from __future__ import annotations

import logging
import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from ray._private import worker
from ray.util.placement_group import PlacementGroup, placement_group, remove_placement_group

from apex_bat.config import Config
from apex_bat.config.settings import MOST_ACTORS
from apex_bat.launching.cluster.fleet import Fleet
from apex_bat.launching.cluster.keeper import MARK, free_port
from apex_bat.launching.cluster.lease import MARGIN_S
from apex_bat.launching.cluster.placement import (
    ClusterError,
    Resources,
    as_text,
    core_roles,
    demand_of,
    num_places,
    num_places_beside,
    reserved_roles,
    shortage,
)
from apex_bat.launching.cluster.ray_keepers import RayPlacer, own_address
from apex_bat.launching.course import Course, Ended
from apex_bat.launching.live import View
from apex_bat.launching.local import terminable
from apex_bat.launching.standing import NEW_RUN, Origin
from apex_bat.launching.status import STATUS, read_status
from apex_bat.roles.logs import launcher_log
from apex_bat.roles.orders import ORPHANED_S
from apex_bat.roles.plan import Role, roles_of
from apex_bat.roles.process import ADDRESSES
from apex_bat.storage import StorageError, write_text
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import Keys, load_keys, new_keys

_QUIET_S = 2.0  # a place that is found within it is not worth a line
_LOOK_S = 0.2
_MOST_AT_ONCE = 16  # actors added by one look
_free: Callable[[], Resources] = ray.available_resources
_all_nodes: Callable[[], list[dict[str, Any]]] = ray.nodes
_log = logging.getLogger(__name__)


@contextmanager
def connected(address: str) -> Iterator[None]:
    """Is connected to a cluster while the block lasts; keeps a connection that is there already.

    Args:
        address: `auto`, or HOST:PORT of the head.

    Raises:
        ClusterError: it cannot be reached.
    """
    if address.startswith("ray://"):
        raise ClusterError(
            f"--cluster {address}: the launcher must run on a node of the cluster: start it there, or `ray job submit`"
        )
    if ray.is_initialized():
        yield
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if hasattr(worker, "print_to_stdstream"):
        worker.print_to_stdstream = _note  # type: ignore[assignment]
    try:
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR, configure_logging=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ClusterError(
            f"--cluster {address}: no connection ({reason}); does Ray run on this machine (`ray status`), and is "
            "RAY_AUTH_MODE with its token the same here as on the head?"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def num_actor_places(config: Config) -> int:
    """Returns how many actors the cluster has room for beside the other roles, at least 1."""
    nodes = _nodes()
    core = [demand_of(role, config, _has_gpu(nodes)) for role in core_roles(config)]
    return max(1, num_places_beside(core, demand_of(Role("actor", 0), config, has_gpu=False), nodes))


def train(config: Config, run: Path, view: View, *, origin: Origin = NEW_RUN, part: int = 0) -> Ended:
    """Trains as `local.train` does, with the roles on the cluster that this process is connected to.

    Raises:
        ClusterError: there is no place for the roles.
    """
    run = run.resolve()
    with terminable(), launcher_log(run, config.launch):  # after `ray.init`, which takes SIGTERM for itself
        keys = load_keys(Path(config.transport.keys)) if config.transport.keys else new_keys()
        _await_leases(config, run)
        with _marked(run) as mark, _places(config) as (group, demands):
            collector = _collector(config, keys)
            (run / ADDRESSES).unlink(missing_ok=True)  # of a former part of the run
            placer = RayPlacer(config, run, mark, group, demands)
            with Fleet(config, run, collector, keys, placer) as fleet:
                growth = _Growth(config, fleet)
                return Course(config, run, collector, fleet.start, origin, part, growth.more).go(view)


class _Growth:
    """Finds further actors for a cluster that has grown, where the settings allow it."""

    def __init__(self, config: Config, fleet: Fleet) -> None:
        self._config, self._fleet, self._number = config, fleet, config.actors
        self._demand = demand_of(Role("actor", 0), config, has_gpu=False)

    def more(self) -> list[Role]:
        """Returns actors for which there is room; none while others still wait for a place."""
        if not self._config.cluster.grow or self._fleet.is_waiting:
            return []
        free = _free()  # of all nodes together: one too many waits for a place, which harms nobody
        number = min(num_places(self._demand, [free], _MOST_AT_ONCE), MOST_ACTORS - self._number)
        roles = [Role("actor", self._number + i) for i in range(number)]
        self._number += number
        if roles:
            _log.warning("the cluster has room for %d more actors: %d in all", number, self._number)
        return roles


@contextmanager
def _marked(run: Path) -> Iterator[str]:
    """Yields what a file in the run folder holds meanwhile, by which keepers know that folder."""
    mark = secrets.token_hex(16)
    write_text(run / MARK, mark)
    try:
        yield mark
    finally:
        (run / MARK).unlink(missing_ok=True)


@contextmanager
def _places(config: Config) -> Iterator[tuple[PlacementGroup, dict[str, Resources]]]:
    """Yields a placement group that holds the places of some roles, and what these ask, in the order of its places.

    Raises:
        ClusterError: the cluster has none, after `cluster.wait_s`.
    """
    nodes = _nodes()
    demands = {role.name: demand_of(role, config, _has_gpu(nodes)) for role in reserved_roles(config)}
    group = placement_group(list(demands.values()), strategy="PACK")  # the most goes between replay and learner
    try:
        _await_places(group, demands, config)
        yield group, demands
    finally:
        if ray.is_initialized():
            remove_placement_group(group)


def _await_places(group: PlacementGroup, demands: dict[str, Resources], config: Config) -> None:
    begun_s, is_said = time.monotonic(), False
    while not group.wait(_LOOK_S):
        waited_s = time.monotonic() - begun_s
        if waited_s > config.cluster.wait_s:
            raise ClusterError(
                f"no place in the cluster within {config.cluster.wait_s:g} s (cluster.wait_s); {_shortage(demands)}"
            )
        if waited_s > _QUIET_S and not is_said:
            is_said = True
            _log.warning(
                "waits for a place in the cluster, %g s at most; %s", config.cluster.wait_s, _shortage(demands)
            )


def _await_leases(config: Config, run: Path) -> None:
    """Waits until nothing of a former part of the run lives whose launcher cannot say that it has ended."""
    try:
        has_ended = read_status(run)["launcher"] == "ended"
    except StorageError:  # of a new run there is none
        has_ended = not (run / STATUS).exists()
    if not has_ended:
        wait_s = config.cluster.lease_s + ORPHANED_S + MARGIN_S  # of a keeper that died just before its lease was over
        _log.warning("the former launcher did not end the run: waits %.0f s for what it may have left running", wait_s)
        time.sleep(wait_s)


def _note(data: dict[str, Any], **_: object) -> None:
    """Notes in the log, as one line, what Ray would print of dying nodes: hundreds of lines, whatever it is told."""
    first = next((line for line in "\n".join(map(str, data.get("lines", ()))).splitlines() if line.strip()), "")
    _log.info("Ray: %s", first[:300])


def _shortage(demands: dict[str, Resources]) -> str:
    free = {name: amount for name, amount in _free().items() if name != "object_store_memory"}
    return f"{shortage(demands, _nodes())}. Free of it: {as_text(free)}"


def _collector(config: Config, keys: Keys) -> ReportCollector:
    address = own_address()
    port = free_port(address, config.transport.base_port)
    names = [role.name for role in roles_of(config)]
    return ReportCollector(f"tcp://{address}:{port}", keys=keys, generation=secrets.randbits(63), roles=names)


def _nodes() -> list[Resources]:
    """Returns what each living node has in all."""
    return [node["Resources"] for node in _all_nodes() if node["Alive"]]


def _has_gpu(nodes: list[Resources]) -> bool:
    return any(node.get("GPU", 0.0) > 0.0 for node in nodes)
