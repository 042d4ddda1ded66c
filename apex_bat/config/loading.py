"""Reading settings from TOML files and the command line, and writing what was resolved."""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from apex_bat.config.settings import MOST_ACTORS, Config

MAX_BYTES = 1 << 20  # of a TOML file: all settings take 10 KB, an arena of 60 walls 6 KB
AUTO = "auto"
"""As the number of `actors`: as many as there is room for."""
OTHER_CORES = 2
"""Of a machine, that `actors = "auto"` leaves to learner and replay."""
_LONG_KEY = re.compile(rb"(?:[^\s=.,\[\]{}]+[ \t]*\.[ \t]*){100}")


class ConfigError(ValueError):
    """A setting that is unknown, of the wrong type, out of range or in contradiction with another."""


def places_here(_config: Config) -> int:
    """Returns how many actors `actors = "auto"` means on this machine: its cores less two, at least 1."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores - OTHER_CORES)


def places_anywhere(_config: Config) -> int:
    """Returns how many actors `actors = "auto"` means where results must not depend on the machine: the default."""
    return Config().actors


def load(
    path: Path | None = None,
    overrides: Sequence[str] = (),
    num_places: Callable[[Config], int] = places_here,
    *,
    can_grow: bool = False,
) -> Config:
    """Returns the settings of a TOML file, changed by overrides such as `replay.capacity=50000`.

    Args:
        path: the file; None: the defaults.
        overrides: `section.key=value` with the value in TOML's notation; a bare word is taken as a string, and `none`
            means None where that is allowed.
        num_places: says how many actors `actors = "auto"` means for the other settings; it stands in the result.
        can_grow: whether there may be more of them later: `cluster.grow` is then true in the result.

    Raises:
        ConfigError: names the setting, what was given and what is allowed.
    """
    table = _read(path) if path is not None else {}
    for override in overrides:
        _apply(table, override)
    try:
        if table.get("actors") == AUTO:
            table["actors"] = MOST_ACTORS
            if can_grow:
                table["cluster"] = {"grow": True, **table.get("cluster", {})}
            table["actors"] = min(MOST_ACTORS, num_places(msgspec.convert(table, Config)))
        return msgspec.convert(table, Config)
    except msgspec.ValidationError as error:
        text = _explain(str(error))
        raise ConfigError(_origin(text.partition(":")[0], path, overrides) + text) from None
    except RecursionError:
        raise ConfigError(f"{path or '--set'}: tables within tables without end") from None


def save(config: Config, path: Path) -> None:
    """Writes all settings as TOML. TOML has no null: the word "none" stands for it, where None is not the default."""
    path.write_text(dumps(config), encoding="utf-8")


def dumps(config: Config) -> str:
    """Returns all settings as TOML text, which `load` reads back to an equal object."""
    return tomli_w.dumps(_without_none(msgspec.to_builtins(config), Config()))


def differences(left: Config, right: Config) -> list[str]:
    """Returns a line for each setting in which two configurations differ: `key: left | right`."""
    a, b = _flatten(msgspec.to_builtins(left)), _flatten(msgspec.to_builtins(right))
    return [f"{key}: {a[key]} | {b[key]}" for key in a if a[key] != b[key]]


def parse_toml(data: bytes) -> dict[str, Any]:
    """Returns the table in the bytes of a TOML file, in a time that its size bounds.

    Raises:
        ValueError: it is no TOML, larger than MAX_BYTES, or has a key of 100 parts: the time for one grows with the
            square of their number, minutes for 50,000 (measured). Numbers of thousands of digits raise it too.
        RecursionError: arrays or tables within one another without end.
    """
    if len(data) > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES} bytes")
    if _LONG_KEY.search(data):
        raise ValueError("a key of a hundred parts")
    return tomllib.loads(data.decode("utf-8"))


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return _with_none(parse_toml(file.read(MAX_BYTES + 1)))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; configurations that ship are in configs/") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


def _with_none(table: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _with_none(value) if isinstance(value, dict) else None if value == "none" else value
        for key, value in table.items()
    }


def _apply(table: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    parts = key.strip().split(".")
    if not separator or not all(parts):
        raise ConfigError(f"--set {override}: expected section.key=value, for example --set replay.capacity=50000")
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ConfigError(f"--set {override}: {part} is a value, not a section")
    table[parts[-1]] = _value(text.strip())


def _value(text: str) -> Any:
    if text.strip("\"'") == "none":
        return None
    try:
        return parse_toml(f"value = {text}".encode())["value"]
    except (ValueError, RecursionError):
        return text


def _origin(name: str, path: Path | None, overrides: Sequence[str]) -> str:
    """Returns where the value of a setting, or of one in a section, came from: the last override of it, or the file."""
    for override in reversed(overrides):
        key = override.partition("=")[0].strip()
        if name == key or name.startswith((f"{key}.", f"{key}[")) or key.startswith(f"{name}."):
            return f"--set {override}: "
    return f"{path}: " if path is not None else ""


def _explain(message: str) -> str:
    """Turns msgspec's message into one that names the setting and, for an unknown one, the nearest that exists."""
    text, _, where = message.partition(" - at `$")
    section = where.strip("`.")
    unknown = re.search(r"unknown field `(.+)`", text)
    if unknown is None:
        return f"{section}: {text[0].lower()}{text[1:]}" if section else text
    name = f"{section}.{unknown[1]}" if section else unknown[1]
    known = list(_flatten(msgspec.to_builtins(Config()), sections=True))
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5) or [
        key for key in known if key.rpartition(".")[2] == unknown[1]
    ]
    hint = f"; did you mean {near[0]}?" if near else "; `apex-bat train --help` says where the settings are listed"
    return f"{name}: no such setting{hint}"


def _flatten(table: dict[str, Any], prefix: str = "", sections: bool = False) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            if sections:
                flat[prefix + key] = value
            flat |= _flatten(value, f"{prefix}{key}.", sections)
        else:
            flat[prefix + key] = value
    return flat


def _without_none(table: dict[str, Any], default: msgspec.Struct) -> dict[str, Any]:
    kept: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            kept[key] = _without_none(value, getattr(default, key))
        elif value is not None:
            kept[key] = value
        elif getattr(default, key) is not None:
            kept[key] = "none"
    return kept
