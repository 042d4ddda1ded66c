r"""The command of the contest.

    make peers          # once: a virtual environment for each library, in .peers/
    python -m benchmarks.peers --budget-s 600 --seeds 3 --json docs/results/peers.json

Interrupted, the same command goes on. The page and its picture are written beside the JSON.

Trials of a peer's own settings (threads, bats, learning_rate, adam; RLlib's runners and fragment) go into a file of
their own, which the page shows as a table:

    python -m benchmarks.peers --only sb3 --environments registered --seeds 1 --budget-s 300 --set adam=1 \
        --json docs/results/peers_trials.json
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from apex_bat.launching import ONE_THREAD
from benchmarks.peers.contest import Options, PeerError, hold, starts
from benchmarks.peers.report import TRIALS_SUFFIX as TRIALS
from benchmarks.peers.report import write
from benchmarks.peers.terms import ENTRIES, ENVIRONMENTS, Environment, entry_of


def main() -> int:
    """Runs the contest; returns 1 if a training failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--budget-s", type=float, default=600.0, help="wall-clock time of a training, from its start")
    parser.add_argument("--obvious-budget-s", type=float, help="the same in the obvious environment [as --budget-s]")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--every-s", type=float, default=5.0, help="time between policies that may be judged")
    parser.add_argument("--only", help="names of entries, separated by commas; also those of ablations")
    parser.add_argument("--environments", default=",".join(ENVIRONMENTS))
    parser.add_argument("--json", type=Path, default=Path("docs/results/peers.json"), dest="file")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=NUMBER", dest="overrides",
                        help="a setting of the peer itself, for a trial (into another file!)")  # fmt: skip
    parser.add_argument("--keep", action="store_true", help="keep the folders of the trainings, .peers/runs")
    given = parser.parse_args()
    entries = [entry_of(name) for name in given.only.split(",")] if given.only else list(ENTRIES)
    environments = [name for name in ENVIRONMENTS if name in given.environments.split(",")]
    budgets_s: dict[Environment, float] = {
        "registered": given.budget_s,
        "obvious": given.obvious_budget_s or given.budget_s,
    }
    options = Options(given.file, budgets_s, given.every_s, tuple(given.overrides), given.keep)
    for name in ONE_THREAD:  # in the processes that judge: idle BLAS threads that spin halve the simulation's rate
        os.environ.setdefault(name, "1")
    has_failed = False
    try:
        for line in hold(starts(entries, environments, given.seeds), options):
            print(line, flush=True)
            has_failed |= ": failed: " in line
    except PeerError as error:
        parser.error(str(error))
    if given.file.exists() and not given.file.stem.endswith(TRIALS):
        print(f"written: {write(given.file)}")
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main())
