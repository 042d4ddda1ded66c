"""The process of one peer's training, in the virtual environment of its library.

`benchmarks.peers.contest` starts it as `python -m benchmarks.peers.training NAME ...`.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping
from importlib import import_module, metadata
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from apex_bat.config import Config
from benchmarks.peers.notebook import Notebook
from benchmarks.peers.terms import ENVIRONMENTS, NUM_BATS, Environment, entry_of, terms

VERSIONS = "versions.json"


class Task(NamedTuple):
    """What a peer is to do."""

    environment: Environment
    seed: int
    config: Config
    notebook: Notebook
    folder: Path
    """For whatever the library writes."""
    overrides: dict[str, float]
    """The peer's own settings that a trial changes."""

    def settings(self, own: Mapping[str, float] = MappingProxyType({})) -> dict[str, float]:
        """Returns the settings of a peer that a trial may change, with its changes.

        Args:
            own: what only this library has.

        Raises:
            ValueError: a trial changes what there is not.
        """
        learner = self.config.learner
        shared = {
            "threads": 1, "bats": NUM_BATS, "adam": 0, "learning_rate": learner.learning_rate,
            "target_period": learner.target_period,
        }  # fmt: skip
        there = {**shared, **own}
        if unknown := sorted(self.overrides.keys() - there):
            raise ValueError(f"no setting {', '.join(unknown)}; there are {', '.join(there)}")
        return there | self.overrides


def main() -> None:
    """Trains until the budget is spent."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("--environment", choices=ENVIRONMENTS, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--begin-s", type=float, required=True, help="when the process was started, monotonic clock")
    parser.add_argument("--budget-s", type=float, required=True)
    parser.add_argument("--every-s", type=float, required=True)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=NUMBER", dest="overrides")
    given = parser.parse_args()
    entry, config = entry_of(given.name), terms()
    versions = {package: metadata.version(package) for package in entry.packages}
    (given.folder / VERSIONS).write_text(json.dumps(versions), encoding="utf-8")
    notebook = Notebook(given.folder, config, given.begin_s, given.budget_s, given.every_s)
    overrides = {key: float(value) for key, _, value in (text.partition("=") for text in given.overrides)}
    peer = import_module(f"benchmarks.peers.{entry.name}_peer")
    peer.train(Task(given.environment, given.seed, config, notebook, given.folder, overrides))
    os._exit(0)  # a library's threads and servers need not end in order: the contest ends what is left


if __name__ == "__main__":
    main()
