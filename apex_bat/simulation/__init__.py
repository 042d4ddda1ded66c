"""The bat's world and ear: arenas, PyBullet world, rays, sonar, cochlea and the Gymnasium environments.

`Sonar`, `Echo` and `Listener` are loaded when they are first asked for: the filters of scipy take a while to import.
"""

from typing import TYPE_CHECKING

from apex_bat.simulation.registration import register_environments

if TYPE_CHECKING:
    from apex_bat.simulation.echo import Echo
    from apex_bat.simulation.listener import Listener
    from apex_bat.simulation.sonar import Sonar

__all__ = ["Echo", "Listener", "Sonar", "register_environments"]

register_environments()


def __getattr__(name: str) -> object:
    """Loads the public ear on first use."""
    if name in ("Echo", "Listener", "Sonar"):
        from apex_bat.simulation import sonar

        return getattr(sonar, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
