"""Settings: frozen, documented, checked. `load` reads a TOML file and overrides; `save` writes what was resolved."""

from apex_bat.config.loading import ConfigError, dumps, load, save
from apex_bat.config.settings import Config

__all__ = ["Config", "ConfigError", "dumps", "load", "save"]
