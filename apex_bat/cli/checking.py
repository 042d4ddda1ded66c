"""What is refused before anything is started."""

from __future__ import annotations

import math
from pathlib import Path

from apex_bat.config import Config, ConfigError

_BYTES_A_TRANSITION = 1024  # on the wire, at most: a chunk of one transition brings four frames of 192 bytes along
_HEADER_BYTES = 1 << 14  # of a message of weights: names and shapes


def check(config: Config, *, serial: bool = False, on_cluster: bool = False) -> None:
    """Refuses settings that no role could work with, before anything is started.

    Raises:
        ConfigError, ArenaError, TransportError: they name the setting.
    """
    from apex_bat.agent.inference import parameter_shapes
    from apex_bat.replay.store import limiter_of
    from apex_bat.simulation.arenas import load_arenas
    from apex_bat.transport.security import load_keys
    from apex_bat.transport.sockets import check_address

    if serial:
        from apex_bat.launching.serial import settings_of

        settings_of(config)
    if config.replay.shards > 1 and serial:
        raise ConfigError(f"replay.shards is {config.replay.shards}, and a serial run has one replay: set it to 1")
    try:
        limiter_of(config)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    _check_inserts(config)
    for arena in dict.fromkeys((config.arena, *config.evaluation.arenas)):
        load_arenas(arena)
    try:
        shapes = parameter_shapes(config.network, config.state_steps)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    _check_weights(config, sum(math.prod(shape) for shape in shapes.values()))
    keys = load_keys(Path(config.transport.keys)) if config.transport.keys else None
    if on_cluster and config.transport.host != "ipc":
        raise ConfigError("transport.host: on a cluster each role listens at its node's address; leave it out")
    if config.transport.host != "ipc":
        check_address(f"tcp://{config.transport.host}:{config.transport.base_port}", keys)


def _check_weights(config: Config, num_parameters: int) -> None:
    """Refuses settings with which actors would refuse the learner's weights."""
    needed_mb = (4 * num_parameters + _HEADER_BYTES) / 2**20
    if config.transport.max_message_mb < needed_mb:
        raise ConfigError(
            f"transport.max_message_mb {config.transport.max_message_mb:g} is less than the {needed_mb:.3g} MB that "
            f"weights of {num_parameters} parameters take"
        )


def _check_inserts(config: Config) -> None:
    """Refuses settings with which the largest insert of an actor would be refused again and again."""
    capacity = config.replay.capacity // config.replay.shards
    if capacity < config.largest_insert:
        shards = config.replay.shards
        each = f", {capacity} at each of {shards} servers," if shards > 1 else ""
        raise ConfigError(
            f"replay.capacity {config.replay.capacity}{each} is less than the {config.largest_insert} transitions that "
            f"the {config.bats_per_actor} bats of an actor may send at once; give more, or fewer bats_per_actor"
        )
    needed_mb = config.largest_insert * _BYTES_A_TRANSITION / 2**20
    if config.transport.max_message_mb < needed_mb:
        raise ConfigError(
            f"transport.max_message_mb {config.transport.max_message_mb:g} is less than the {needed_mb:.2g} MB that an "
            f"insert of {config.largest_insert} transitions may take"
        )
