"""What the roles ask of a cluster, and what is said when it has not that much: numbers and text, without Ray."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from apex_bat.config import Config
from apex_bat.roles.plan import Role, roles_of

Resources = dict[str, float]
"""Amounts by name, as Ray counts them: CPU, GPU, memory [bytes], and whatever `ray start --resources` says."""

BYTES_A_TRANSITION = 600
REPLAY_BYTES = 500_000_000  # of the process without experience: 60 MB, and room
_MOST_SHOWN = 8  # nodes in a message


class ClusterError(RuntimeError):
    """The cluster cannot be used; the message is one line that says what and what to do."""


def demand_of(role: Role, config: Config, has_gpu: bool) -> Resources:
    """Returns what a role asks for.

    Args:
        role: which.
        config: the settings.
        has_gpu: whether the cluster has a GPU.
    """
    cluster = config.cluster
    if role.kind == "learner":
        gpus = cluster.learner_gpus
        if gpus is None:
            gpus = 1.0 if has_gpu and config.device != "cpu" else 0.0
        demand = {"CPU": float(config.train.threads), "GPU": gpus, cluster.learner_resource: 1.0}
    elif role.kind == "replay":
        demand = {"CPU": cluster.role_cpus, "memory": _replay_bytes(config), cluster.replay_resource: 1.0}
    elif role.kind == "actor":
        demand = {"CPU": cluster.role_cpus, cluster.actor_resource: 1.0}
    else:
        demand = {"CPU": cluster.role_cpus}
    return {name: amount for name, amount in demand.items() if name and amount > 0.0}


def core_roles(config: Config) -> list[Role]:
    """Returns the roles without which there is no run: all but the actors, which may come and go."""
    return [role for role in roles_of(config) if role.kind != "actor"]


def reserved_roles(config: Config) -> list[Role]:
    """Returns the roles whose places are reserved: those without which there is no run, and one actor to fly in it."""
    return [*core_roles(config), Role("actor", 0)]


def num_places_beside(core: Sequence[Resources], demand: Resources, nodes: Sequence[Mapping[str, float]]) -> int:
    """Returns how often a demand fits into what nodes have when each of `core` has found a place first."""
    free = [dict(node) for node in nodes]
    for each in core:
        place = next((node for node in free if has_room(each, node)), None)
        if place is not None:
            take(each, place)
    return num_places(demand, free)


def num_places(demand: Resources, nodes: Sequence[Mapping[str, float]], most: int = 4096) -> int:
    """Returns how often a demand fits beside itself into what nodes have."""
    free, number = [dict(node) for node in nodes], 0
    for node in free:
        while number < most and has_room(demand, node):
            take(demand, node)
            number += 1
    return number


def has_room(demand: Resources, node: Mapping[str, float]) -> bool:
    """Whether a node has what is asked."""
    return all(node.get(name, 0.0) >= amount - 1e-9 for name, amount in demand.items())


def take(demand: Resources, node: Resources) -> None:
    """Takes what is asked from a node."""
    for name, amount in demand.items():
        node[name] -= amount


def shortage(demands: Mapping[str, Resources], nodes: Sequence[Mapping[str, float]]) -> str:
    """Returns a line on what is asked and what there is.

    Args:
        demands: of each role, by name.
        nodes: what each living node has in all.
    """
    asked = "; ".join(f"{name}: {as_text(demand)}" for name, demand in demands.items())
    there = "; ".join(as_text(node) for node in nodes[:_MOST_SHOWN]) or "no node"
    more = f"; and {len(nodes) - _MOST_SHOWN} more nodes" if len(nodes) > _MOST_SHOWN else ""
    return f"asked: {asked}. There is: {there}{more}"


def as_text(amounts: Mapping[str, float]) -> str:
    """Returns amounts as text, such as `2 CPU, 0.62 GB memory`; what Ray counts for itself is left out."""
    parts = []
    for name, amount in amounts.items():
        if name == "memory":
            parts.append(f"{amount / 1e9:.2g} GB memory")
        elif not name.startswith(("node:", "object_store_memory", "accelerator_type:")):
            parts.append(f"{amount:g} {name}")
    return ", ".join(parts) or "nothing"


def _replay_bytes(config: Config) -> float:
    given = config.cluster.replay_memory_gb
    return (
        given * 1e9
        if given is not None
        else REPLAY_BYTES + BYTES_A_TRANSITION * config.replay.capacity / config.replay.shards
    )
