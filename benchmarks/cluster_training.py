"""A whole training across hosts: whether it makes the same bat as one on a single machine.

    sudo python -m benchmarks.cluster_training --json docs/results/cluster_training.json

Trains `configs/memory.toml` on the network of `cluster_faults`, a head and two workers, with the replay and the learner
on workers and an actor on each of two hosts; then the bat is judged like any other. All of it on the cores of one
machine: the minutes are not those of three hosts. Needs root, iproute2 and util-linux.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.cluster_faults import Network, hosts

CONFIG = Path(__file__).parents[1] / "configs" / "memory.toml"
BUDGET = 180_000
"""Environment steps, as those of a training of `apex-bat reproduce`."""
SETTINGS = (
    "actors=2", "cluster.role_cpus=0.5", "cluster.replay_resource=server", "cluster.learner_resource=server",
    "cluster.actor_resource=wing", "train.max_minutes=60", "evaluation.arenas=[]",
)  # fmt: skip
WORKER, HEAD = '{"server":1,"wing":1}', '{"head":1}'
LIMIT_S = 3600.0


def main() -> None:
    """Trains, judges and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--budget", type=int, default=BUDGET, help="environment steps")
    parser.add_argument("--folder", type=Path, default=Path.home() / ".apex_bat_netns", help="for the hosts' files")
    given = parser.parse_args()
    with hosts(given.folder, None, head=HEAD, worker=WORKER) as network:
        content = trained(network, given.budget)
    print(json.dumps(content, indent=1))
    if given.json is not None:
        given.json.write_text(json.dumps(content, indent=1) + "\n")


def trained(network: Network, budget: int) -> dict[str, Any]:
    """Returns where the roles were, what the training took, and how the bat flies."""
    network.shared.mkdir(parents=True, exist_ok=True)
    run = network.shared / "training"
    settings = [word for one in (*SETTINGS, f"train.max_env_steps={budget}") for word in ("--set", one)]
    begun_s = time.monotonic()
    training = network.begin(
        sys.executable, "-m", "apex_bat", "train", "--cluster", "auto", "--plain", "--config", str(CONFIG),
        "--run", str(run), *settings, log=network.shared / "training.log",
    )  # fmt: skip
    seen: dict[str, str] = {}
    while training.poll() is None:
        if time.monotonic() - begun_s > LIMIT_S:
            training.terminate()
            raise SystemExit(f"not within {LIMIT_S:g} s")
        time.sleep(1.0)
        try:
            roles = json.loads((run / "status.json").read_text())["roles"]
        except (OSError, ValueError):
            continue
        seen |= {row["role"]: row["host"] for row in roles if row["host"]}
    if training.returncode:
        raise SystemExit((network.shared / "training.log").read_text()[-2000:])
    minutes = (time.monotonic() - begun_s) / 60.0
    result = network.shared / "flights.json"
    subprocess.run(
        [sys.executable, "-m", "apex_bat", "evaluate", str(run), "--arenas", "simple,narrow,circle", "--json",
         str(result)], check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    judged = json.loads(result.read_text())
    return {
        "hosts": seen,
        "minutes": round(minutes, 1),
        "training": judged["training"],
        "summary": judged["summary"],
    }


if __name__ == "__main__":
    main()
