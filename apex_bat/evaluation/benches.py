"""Finds the benchmarks of a checkout and runs them."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from apex_bat.config import ConfigError

PARTS = ("simulation", "replay", "snapshot", "wire", "recording", "learner", "system", "scaling")
LONG = "scaling"
"""Not part of `all`: it takes five minutes of whole runs."""
_CHECKOUT = Path(__file__).resolve().parents[2]


def measure(part: str) -> list[dict[str, Any]]:
    """Returns the records of one part, or of `all` but scaling: name, unit, median, min, max, runs.

    Raises:
        ConfigError: there is no such part, or the package does not lie in a checkout.
    """
    if part not in (*PARTS, "all"):
        raise ConfigError(f"bench {part}: no such part; there are {', '.join(PARTS)} and all")
    if not (_CHECKOUT / "benchmarks").is_dir():
        raise ConfigError("the benchmarks are not installed with the package; run this from a checkout")
    if str(_CHECKOUT) not in sys.path:
        sys.path.insert(0, str(_CHECKOUT))
    records: list[dict[str, Any]] = []
    for name in (each for each in PARTS if each != LONG) if part == "all" else (part,):
        records += importlib.import_module(f"benchmarks.{name}").measure()
    return records
