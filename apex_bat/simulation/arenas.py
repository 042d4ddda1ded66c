"""Arenas by name: shipped ones, a user's TOML file, or members of the generated families.

A name is `simple` (a file under configs/arenas), `yard.toml` (a path), `corridor:7` (a family and a seed),
`corridor:0-31` (a range of seeds), `corridor:*` (the first seeds of the family), or several of these with commas.
"""

from __future__ import annotations

import sysconfig
from functools import cache
from pathlib import Path

import msgspec

from apex_bat.config.loading import MAX_BYTES, parse_toml
from apex_bat.config.settings import Body, Episode
from apex_bat.simulation.generated import FAMILIES, POOL_SIZE, generate_arena
from apex_bat.simulation.layout import Arena, ArenaError, Model, Pillar, Wall
from apex_bat.simulation.starts import start_region

__all__ = ["Arena", "ArenaError", "Model", "Pillar", "Wall", "arena_folder", "arena_names", "load_arena", "load_arenas"]


def load_arena(name: str | Path, *, body: Body | None = None, episode: Episode | None = None) -> Arena:
    """Returns the one arena of a name or path, checked to have safe starts.

    Args:
        name: see the module's docstring; one arena only.
        body: the robot that must find a start there; None: the default.
        episode: says how far from the walls a start must be; None: the default.

    Raises:
        ArenaError: names the arena and what is wrong with it, or those that exist.
    """
    arenas = load_arenas(name, body=body, episode=episode)
    if len(arenas) > 1:
        raise ArenaError(
            f"{name}: these are {len(arenas)} arenas, and one is wanted here; name one, for example {arenas[0].name}"
        )
    return arenas[0]


def load_arenas(names: str | Path, *, body: Body | None = None, episode: Episode | None = None) -> tuple[Arena, ...]:
    """Returns every arena that a name stands for, in order, each checked to have safe starts.

    Raises:
        ArenaError: as `load_arena`.
    """
    parts = [part.strip() for part in str(names).split(",")] if isinstance(names, str) else [str(names)]
    arenas = tuple(arena for part in parts for arena in _resolve(part))
    for arena in arenas:
        start_region(arena, body or Body(), episode or Episode())
    return arenas


def arena_names(names: str) -> tuple[str, ...]:
    """Returns for each arena that a name stands for, in the order of `load_arenas`, a name that stands for it alone.

    Raises:
        ArenaError: as `load_arena`.
    """
    found = [(part.strip(), _resolve(part.strip())) for part in names.split(",")]
    return tuple(part if len(arenas) == 1 else arena.name for part, arenas in found for arena in arenas)


def arena_folder() -> Path:
    """Returns the folder of the shipped arenas: configs/arenas of a checkout, or where an installation put it."""
    checkout = Path(__file__).resolve().parents[2] / "configs" / "arenas"
    return checkout if checkout.is_dir() else Path(sysconfig.get_path("data")) / "share" / "apex_bat" / "arenas"


def _resolve(name: str) -> list[Arena]:
    family, colon, seeds = name.partition(":")
    if colon and family in FAMILIES:
        return [generate_arena(family, seed) for seed in _seeds(name, seeds)]
    if name.endswith(".toml") or "/" in name or "\\" in name:
        return [_read(Path(name).resolve())]
    path = arena_folder() / f"{name}.toml"
    if not name or not path.is_file():
        shipped = ", ".join(sorted(file.stem for file in arena_folder().glob("*.toml")))
        families = ", ".join(f"{family}:SEED" for family in FAMILIES)
        raise ArenaError(
            f"{name}: no such arena; there are {shipped}, the generated {families}, and paths to .toml files"
        )
    return [_read(path)]


def _seeds(name: str, text: str) -> range:
    if text == "*":
        return range(POOL_SIZE)
    first, dash, last = text.partition("-")
    if not (first.isdecimal() and (last.isdecimal() or not dash)):
        raise ArenaError(f"{name}: expected a seed as in corridor:7, a range as in corridor:0-31, or corridor:*")
    seeds = range(int(first), int(last or first) + 1)
    if not seeds:
        raise ArenaError(f"{name}: the range of seeds is empty; write the smaller one first")
    return seeds


@cache
def _read(path: Path) -> Arena:
    try:
        with path.open("rb") as file:
            table = parse_toml(file.read(MAX_BYTES + 1))
    except FileNotFoundError:
        raise ArenaError(f"{path}: no such arena file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ArenaError(f"{path}: cannot be read: {error}") from None
    except (ValueError, RecursionError) as error:
        raise ArenaError(f"{path}: not valid TOML: {error}") from None
    try:
        arena = msgspec.convert(table, Arena)
    except (msgspec.ValidationError, RecursionError) as error:
        raise ArenaError(f"{path}: malformed arena: {error}") from None
    models = tuple(model._replace(file=str(path.parent / model.file)) for model in arena.models)
    return msgspec.structs.replace(arena, name=arena.name or path.stem, models=models)
