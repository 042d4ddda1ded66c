"""Keepers in actors of Ray: what makes them, and carries the calls to them.

Actors of Ray are never restarted by Ray itself: the supervisor decides on restarts, and Ray knows neither backoff nor
exit codes.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import ray
from ray.util.placement_group import PlacementGroup, placement_group_table
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from apex_bat.config import Config
from apex_bat.launching.cluster.keeper import Keeper, Look, Site
from apex_bat.launching.cluster.kept import Fate, LostError, Remote
from apex_bat.launching.cluster.placement import Resources, as_text, demand_of
from apex_bat.roles.plan import Role

own_address: Callable[[], str] = ray.util.get_node_ip_address
_nodes: Callable[[], list[dict[str, Any]]] = ray.nodes
_CONNECT_S = 0.4
_log = logging.getLogger(__name__)


class RayPlacer:
    """Makes keepers: those of the roles of the placement group in it, further actors spread over the rest."""

    def __init__(
        self, config: Config, run: Path, mark: str, group: PlacementGroup, demands: dict[str, Resources]
    ) -> None:
        """Takes what every keeper is told, and what they ask.

        Args:
            config: the settings.
            run: the run folder.
            mark: what the file MARK in it holds.
            group: places that are reserved.
            demands: of the roles that these are for, in their order. They stay as they are: a GPU that comes later is
                in none of the places.
        """
        self._group, self._demands = group, demands
        self._actor_demand = demand_of(Role("actor", 0), config, has_gpu=False)
        self._given = (str(run), mark, str(Path.cwd()), config.cluster.lease_s, config.transport.base_port)
        self._bundles = {name: index for index, name in enumerate(demands)}

    def asks(self, role: Role) -> str:
        """Returns what a role asks of the cluster, as text."""
        return as_text(self._demand(role))

    def place(self, role: Role, away_from: str = "", *, is_reserved: bool = True) -> Remote:
        """Asks for a place with a keeper; returns at once.

        Where the role's own place is on the node that is to be left, one outside the group is asked for: those within
        it move only when Ray itself has given that node up.
        """
        demand = dict(self._demand(role))
        options: dict[str, Any] = {"num_cpus": demand.pop("CPU"), "num_gpus": demand.pop("GPU", 0)}
        strategy: Any = "SPREAD"
        index = self._bundles.get(role.name) if is_reserved else None
        if index is not None and not (away_from and self._node_of(index) in ("", away_from)):
            strategy = PlacementGroupSchedulingStrategy(self._group, index)
        elif away_from:
            options["label_selector"] = {"ray.io/node-id": f"!{away_from}"}
        if memory := demand.pop("memory", 0.0):
            options["memory"] = int(memory)
        keeper = _RemoteKeeper.options(  # type: ignore[attr-defined]
            resources=demand, scheduling_strategy=strategy, max_restarts=0, max_task_retries=0, **options
        ).remote(*self._given)
        return _RayRemote(keeper)

    def reserves(self, role: Role) -> bool:
        """Whether the group holds a place for a role."""
        return role.name in self._bundles

    def is_short(self) -> bool:
        """Whether Ray looks for places anew for the group, because a node is gone that had one."""
        return str(placement_group_table(self._group).get("state")) != "CREATED"

    def fates(self, nodes: Collection[str]) -> dict[str, Fate]:
        """Returns what is known of nodes: from Ray, or from the port of its daemon there."""
        try:
            known = {node["NodeID"]: node for node in _nodes()}
        except (ray.exceptions.RayError, OSError) as error:
            _log.warning("the head of the cluster does not answer: %s", error)
            return dict.fromkeys(nodes, "unknown")
        living = {node: known[node] for node in nodes if node in known and known[node]["Alive"]}
        ports = [(str(node["NodeManagerAddress"]), int(node["NodeManagerPort"])) for node in living.values()]
        refusing = dict(zip(living, asyncio.run(_refusing(ports)), strict=True))
        return {node: ("refusing" if refusing[node] else "unknown") if node in living else "removed" for node in nodes}

    def answers(self, tickets: list[object], timeout_s: float) -> Iterator[tuple[object, object]]:
        """Yields ticket and answer, or the error, of those that are answered within the time."""
        if not tickets:
            time.sleep(timeout_s)
            return
        ready, _ = ray.wait(tickets, num_returns=len(tickets), timeout=timeout_s)
        for ticket in ready:
            try:
                yield ticket, ray.get(ticket)
            except ray.exceptions.ActorUnavailableError:  # for the moment; the call may have come through or not
                yield ticket, OSError("its host does not answer")
            except ray.exceptions.RayTaskError as error:
                yield ticket, _raised(error)
            except ray.exceptions.RayError as error:
                yield ticket, LostError(_reason(error))

    def _node_of(self, index: int) -> str:
        """Returns where a place of the group is; empty while it is nowhere."""
        return str(placement_group_table(self._group).get("bundles_to_node_id", {}).get(index, ""))

    def _demand(self, role: Role) -> Resources:
        return self._demands.get(role.name, self._actor_demand)


@ray.remote
class _RemoteKeeper:
    """A keeper in an actor of Ray."""

    def __init__(self, run: str, mark: str, folder: str, lease_s: float, base_port: int) -> None:
        node = ray.get_runtime_context().get_node_id()
        self._keeper = Keeper(run, mark, folder, lease_s, own_address(), base_port, node)

    def site(self, versions: tuple[str, str], role: Role) -> Site:
        return self._keeper.site(versions, role)

    def prepare(self, *given: Any) -> None:
        self._keeper.prepare(*given)

    def start(self, *given: Any) -> int:
        return self._keeper.start(*given)

    def look(self, seen: int, orders: bytes | None) -> Look:
        return self._keeper.look(seen, orders)

    def stop(self) -> None:
        self._keeper.stop()

    def kill(self) -> None:
        self._keeper.kill()


class _RayRemote:
    """Calls to one keeper; each returns a ticket at once."""

    def __init__(self, keeper: Any) -> None:
        self._keeper = keeper

    def call(self, method: str, *given: object) -> object:
        return getattr(self._keeper, method).remote(*given)

    def dismiss(self) -> None:
        ray.kill(self._keeper, no_restart=True)


async def _refusing(ports: list[tuple[str, int]]) -> list[bool]:
    """Returns whether TCP ports refuse connections; False of one that takes them or is silent."""

    async def refuses(host: str, port: int) -> bool:
        try:
            _, writer = await asyncio.wait_for(asyncio.open_connection(host, port), _CONNECT_S)
        except ConnectionRefusedError:
            return True
        except (OSError, TimeoutError):
            return False
        writer.close()
        return False

    return list(await asyncio.gather(*(refuses(*one) for one in ports)))


def _raised(error: ray.exceptions.RayTaskError) -> Exception:
    """Returns what a method of a keeper raised, with the number of an OSError."""
    cause = error.cause
    if not isinstance(cause, OSError):
        return RuntimeError(_reason(error))
    return OSError(_reason(error)) if cause.errno is None else OSError(cause.errno, _reason(error))


def _reason(error: Exception) -> str:
    """Returns the last line of an error of Ray that says something, without the traceback that it carries."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
