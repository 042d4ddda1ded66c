"""The terms of the contest: who takes part, and what is the same for all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

from apex_bat.config import Config, load

ROOT = Path(__file__).resolve().parents[2]
CONFIG_FILE = ROOT / "configs" / "memory.toml"

Environment = Literal["registered", "obvious"]
ENVIRONMENTS: tuple[Environment, ...] = ("registered", "obvious")

NUM_BATS = 16
"""Bats that a peer flies together in the registered environment, as one of apex_bat's actors does."""
NUM_OBVIOUS = 8
"""Processes with one bat each in which a peer flies the obvious environment: it has no form for many."""
ENOUGH = 14
"""Flights of 15 that a policy must complete."""
EPSILONS = (1.0, 0.05)
EPSILON_STEPS = 20_000
"""The peers' exploration falls linearly over so many steps (thesis: 1.0 to 0.01; 0.05 is what the libraries have)."""


class Entry(NamedTuple):
    """One who takes part."""

    name: str
    label: str
    what: str
    """What it is, for the report."""
    packages: tuple[str, ...]
    """Distributions whose versions are noted."""
    environments: tuple[Environment, ...] = ENVIRONMENTS
    settings: tuple[str, ...] = ()
    """What differs from the configuration; for apex_bat."""
    mode: tuple[str, ...] = ()
    """Further arguments of `apex-bat train`; for apex_bat."""

    @property
    def is_peer(self) -> bool:
        """Whether it is another library, in a virtual environment of its own."""
        return not self.name.startswith("apex_bat")


_COMMON = ("gymnasium", "numpy", "torch")
_OURS = ("apex-bat", *_COMMON)
ENTRIES: tuple[Entry, ...] = (
    Entry("apex_bat", "apex_bat", "Ape-X, asynchronous: `apex-bat train` as it ships", _OURS, ("registered",)),
    Entry(
        "tianshou", "Tianshou", "dueling double DQN, prioritized, n = 3: the same algorithm in one process, collecting "
        "and learning by turns", ("tianshou", *_COMMON),
    ),
    Entry(
        "sb3", "Stable-Baselines3", "DQN, n = 3; it has neither double Q-learning nor dueling streams nor priorities",
        ("stable_baselines3", *_COMMON),
    ),
    Entry(
        "rllib", "RLlib", "dueling double DQN, prioritized, n = 3, two environment runners; synchronous (its Ape-X was "
        "removed in 2024)", ("ray", *_COMMON),
    ),
)  # fmt: skip
ABLATIONS: tuple[Entry, ...] = (
    Entry(
        "apex_bat_serial", "apex_bat, serial", "all roles of apex_bat in one process, by turns", _OURS,
        ("registered",), mode=("--serial",),
    ),
    Entry(
        "apex_bat_bare", "apex_bat, bare", "apex_bat without mirror images and without averaged parameters", _OURS,
        ("registered",), settings=("learner.mirror=false", "learner.averaged_updates=0"),
    ),
)  # fmt: skip
"""Not part of a contest unless they are named: they tell what of a difference comes from where."""


def entry_of(name: str) -> Entry:
    """Returns who has a name.

    Raises:
        ValueError: nobody has.
    """
    for entry in (*ENTRIES, *ABLATIONS):
        if entry.name == name:
            return entry
    raise ValueError(f"no entry {name!r}; there are {', '.join(entry.name for entry in (*ENTRIES, *ABLATIONS))}")


def terms() -> Config:
    """Returns the settings that all share: those of configs/memory.toml."""
    return load(CONFIG_FILE)


def updates_of(env_steps: int, config: Config) -> float:
    """Returns how many updates so many environment steps pay for, at the samples per insert of the settings."""
    return env_steps * config.replay.samples_per_insert / config.learner.batch_size


def epsilon_at(env_steps: int) -> float:
    """Returns the peers' epsilon after so many steps of all bats together."""
    start, end = EPSILONS
    return start + min(1.0, env_steps / EPSILON_STEPS) * (end - start)
