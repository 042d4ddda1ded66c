"""Makes the environments known to Gymnasium; runs on `import apex_bat.simulation`, and loads nothing else."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

ENVIRONMENT = "apex_bat/EchoFlight-v0"


def register_environments() -> None:
    """Registers the environment for `gymnasium.make` and `gymnasium.make_vec`; a second call does nothing."""
    if ENVIRONMENT not in registry:
        register(
            id=ENVIRONMENT,
            entry_point="apex_bat.simulation.env:EchoFlight",
            vector_entry_point="apex_bat.simulation.vector:EchoFlightVector",
        )
