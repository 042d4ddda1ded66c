"""How soon training on a cluster goes on after a fault, on a network of hosts on this machine.

    sudo python -m benchmarks.cluster_faults --json docs/results/cluster.json

`cluster_netns.sh` makes a head and two workers of Linux namespaces, each with an address, process numbers and /tmp of
its own, joined by a switch without up-link, and starts Ray on them. A run begins whose replay and learner must be on
workers; then a role is killed, a raylet is killed, and a worker is cut off and joined again: with Ray's default health
check and with a tuned one. At last all processes of the head are killed, the launcher with them; it is switched on
again and the run resumed. Needs root, iproute2 and util-linux. Takes about 6 minutes, and kills only what it started.

Recovery is the time from the fault until the replaced role reports from its new process and the learner's step has
grown since: somebody who watches `apex-bat status` sees no earlier sign. It includes up to a second each of the reports
and of status.json.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from apex_bat.launching.cluster.lease import YOUNG_S

BASH = shutil.which("bash") or "bash"
SCRIPT = Path(__file__).with_name("cluster_netns.sh")
TUNED = (
    '{"health_check_initial_delay_ms":1000,"health_check_period_ms":1000,'
    '"health_check_timeout_ms":1000,"health_check_failure_threshold":3}'
)
TARGET_S = {
    "killed role": 5.0, "killed raylet, default": 20.0, "killed raylet, tuned": 20.0, "cut off, default": 75.0,
    "cut off, tuned": 15.0,
}  # fmt: skip
HEAD_LOST = "head lost, then `--resume`"
SETTINGS = (
    "actors=3", "bats_per_actor=4", "replay.min_size=500", "replay.capacity=50_000", "learner.batch_size=16",
    "network.channels=[4]", "network.strides=[3]", "network.hidden=[16]", "evaluation.flights=1",
    "evaluation.arenas=[]", "evaluation.during_training=false", "checkpoint.period_s=3", "replay.snapshot_period_s=5",
    "recording.every_episodes=0", "recording.curves=false", "train.max_minutes=60", "cluster.role_cpus=0.5",
    "cluster.replay_resource=server", "cluster.learner_resource=server",
)  # fmt: skip
SETTLED_S = 20.0  # before the first fault: the process in reserve for the learner imports meanwhile
LIMIT_S = 150.0
BEGIN, END = "<!-- faults: begin -->", "<!-- faults: end -->"


class Outcome(NamedTuple):
    """What one fault did."""

    fault: str
    role: str
    recovered_s: float
    """From the fault until the role works elsewhere or anew; where the head was lost, from the command that resumes."""
    target_s: float | None
    old_ended_s: float | None
    """From the fault until the old process was gone; None where the fault itself ended it."""
    lease_s: float
    from_host: str
    to_host: str


class Network:
    """Hosts in namespaces, by the script beside this file."""

    def __init__(self, folder: Path, health: str | None, head: str, worker: str) -> None:
        self.shared = folder / "shared"
        self._environment = os.environ | {
            "RC_PY": sys.executable, "RC_DIR": str(folder), "RC_CPUS": "4", "RC_DASHBOARD": "0",
            "RC_RES_HEAD": head, "RC_RES_WORKER": worker, "RC_PREFIX": "ab", "RC_NET": "10.87.0",
            "RAY_worker_niceness": "0",
        }  # fmt: skip
        if health is not None:
            self._environment["RC_SYSCONF"] = health

    def do(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Runs the script."""
        return subprocess.run(
            [BASH, str(SCRIPT), *words],
            env=self._environment,
            text=True,
            capture_output=True,
            check=False,
            timeout=120,
        )

    def begin(self, *words: str, log: Path) -> subprocess.Popen[bytes]:
        """Begins a command on the head."""
        with log.open("wb") as output:
            return subprocess.Popen(
                [BASH, str(SCRIPT), "exec", "head", *words], env=self._environment, stdout=output, stderr=output,
                stdin=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip

    def lives(self, host: str, pid: int) -> bool:
        """Whether a process runs on a host, which may be cut off."""
        return self.do("exec", host, "kill", "-0", str(pid)).returncode == 0


class Run:
    """A training run on the network."""

    def __init__(self, network: Network, lease_s: float) -> None:
        self.network, self.lease_s = network, lease_s
        self.folder = network.shared / f"run-{time.monotonic_ns()}"
        network.shared.mkdir(parents=True, exist_ok=True)
        settings = [word for one in (*SETTINGS, f"cluster.lease_s={lease_s}") for word in ("--set", one)]
        self.log = self.folder.with_suffix(".log")
        self.process = self._begin("--run", str(self.folder), *settings)

    def resume(self) -> None:
        """Goes on with a run whose launcher has died."""
        self.process.wait()
        self.process = self._begin("--resume", str(self.folder))

    def _begin(self, *words: str) -> subprocess.Popen[bytes]:
        command = (sys.executable, "-m", "apex_bat", "train", "--cluster", "auto", "--plain", *words)
        return self.network.begin(*command, log=self.log)

    def roles(self) -> dict[str, dict[str, Any]]:
        """Returns the rows of status.json by role."""
        try:
            content = json.loads((self.folder / "status.json").read_text())
        except (OSError, ValueError):
            return {}
        return {row["role"]: row for row in content["roles"]}

    def until(self, condition: Callable[[dict[str, dict[str, Any]]], bool], what: str) -> float:
        """Waits for something in the status; returns how long it took [s]."""
        begun_s = time.monotonic()
        while not condition(self.roles()):
            if self.process.poll() is not None:
                raise SystemExit(f"the run ended while waiting for: {what}\n{self.log.read_text()[-2000:]}")
            if time.monotonic() - begun_s > LIMIT_S:
                raise SystemExit(f"not within {LIMIT_S:g} s: {what}\n{json.dumps(self.roles(), indent=1)[-3000:]}")
            time.sleep(0.05)
        return time.monotonic() - begun_s

    def learns(self) -> None:
        """Waits until every role works and the learner goes on."""
        step = _step(self.roles())
        self.until(lambda roles: len(roles) > 3 and all(map(_is_at_work, roles.values())), "all roles work")
        self.until(lambda roles: _step(roles) > step + 20, "the learner learns")

    def end(self) -> None:
        """Ends it as Ctrl-C does."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGINT)
            try:
                self.process.wait(30)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait()


def main() -> None:
    """Runs everything and prints it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--page", type=Path, help="page whose table to write anew: docs/cluster.md")
    parser.add_argument("--folder", type=Path, default=Path.home() / ".apex_bat_netns", help="for the hosts' files")
    parser.add_argument("--only", choices=("default", "tuned"), help="with one health check only")
    given = parser.parse_args()
    outcomes: list[Outcome] = []
    load = round(os.getloadavg()[0], 1)
    if given.only != "tuned":
        with hosts(given.folder, None) as network, running(network, lease_s=20.0) as run:
            outcomes += [killed(run, role) for role in ("actor-0", "replay", "learner")]
            outcomes.append(without_raylet(run, "killed raylet, default"))
            outcomes.append(cut(run, "cut off, default"))
    if given.only != "default":
        with hosts(given.folder, TUNED) as network, running(network, lease_s=5.0) as run:
            outcomes.append(without_raylet(run, "killed raylet, tuned"))
            time.sleep(YOUNG_S)  # a role that was just started may take longer to end, and is waited for
            outcomes.append(cut(run, "cut off, tuned"))
            outcomes.append(without_head(run))
    content = {
        "load": load,
        "settings": list(SETTINGS),
        "cores": os.cpu_count(),
        "faults": [one._asdict() for one in outcomes],
    }
    print(table(content))
    if given.json is not None:
        given.json.write_text(json.dumps(content, indent=1) + "\n")
    if given.page is not None:
        before, _, rest = given.page.read_text().partition(BEGIN)
        given.page.write_text(before + BEGIN + "\n" + table(content) + END + rest.partition(END)[2])


def table(content: dict[str, Any]) -> str:
    """Returns the rows of the page, Markdown."""
    lines = [
        "| fault | role | works again after [s] | target [s] | the old process was gone after [s] |",
        "|---|---|--:|--:|--:|",
    ]
    for one in content["faults"]:
        gone = "" if one["old_ended_s"] is None else f"{one['old_ended_s']:.1f}, lease {one['lease_s']:g}"
        target = "" if one["target_s"] is None else f"{one['target_s']:g}"
        lines.append(f"| {one['fault']} | {one['role']} | {one['recovered_s']:.1f} | {target} | {gone} |")
    lines.append(f"\nLoad of the machine by others before: {content['load']:.1f} on {content['cores']} cores.")
    return "\n".join(lines) + "\n"


@contextmanager
def hosts(
    folder: Path, health: str | None, *, head: str = '{"head":1}', worker: str = '{"server":2}'
) -> Iterator[Network]:
    """Yields a network of a head and two workers with Ray and their custom resources, and ends it."""
    network = Network(folder, health, head, worker)
    made = network.do("up", "2")
    try:
        if made.returncode:
            raise SystemExit(made.stderr)
        print(made.stdout.strip(), flush=True)
        yield network
    finally:
        network.do("down")


@contextmanager
def running(network: Network, lease_s: float) -> Iterator[Run]:
    """Yields a run that learns, and ends it."""
    run = Run(network, lease_s)
    try:
        run.learns()
        time.sleep(SETTLED_S)
        yield run
    finally:
        run.end()


def killed(run: Run, role: str) -> Outcome:
    """Kills the process of a role."""
    before = run.roles()[role]
    run.network.do("exec", _host(before), "kill", "-9", str(before["pid"]))
    return _recovery(run, "killed role", role, before, None)


def without_raylet(run: Run, fault: str) -> Outcome:
    """Kills the raylet of the host that holds the learner, and starts Ray there anew afterwards."""
    before = run.roles()["learner"]
    run.network.do("kill-raylet", _host(before))
    outcome = _recovery(run, fault, "learner", before, None)
    run.network.do("ray-stop", _host(before))
    run.network.do("ray-start", _host(before))
    run.learns()
    return outcome


def cut(run: Run, fault: str) -> Outcome:
    """Pulls the cable of the host that holds the replay, and plugs it in again when its roles are at work elsewhere."""
    before = run.roles()["replay"]
    host = _host(before)
    run.network.do("cut", host)
    begun_s = time.monotonic()
    while run.network.lives(host, before["pid"]):
        if time.monotonic() - begun_s > LIMIT_S:
            raise SystemExit("the replay on the cut host lives on")
        time.sleep(0.1)
    outcome = _recovery(run, fault, "replay", before, begun_s)
    run.network.do("heal", host)
    run.learns()
    if run.network.lives(host, before["pid"]):
        raise SystemExit("the old replay lives again")
    return outcome


def without_head(run: Run) -> Outcome:
    """Kills all processes of the head, with the launcher; switches it on again and resumes when the roles are gone."""
    before = run.roles()
    places = {(_host(row), row["pid"]) for row in before.values() if _host(row) != "head"}
    run.network.do("kill", "head")
    begun_s = time.monotonic()
    while any(run.network.lives(host, pid) for host, pid in places):
        if time.monotonic() - begun_s > LIMIT_S:
            raise SystemExit("roles outlive the head of their cluster")
        time.sleep(0.1)
    old_ended_s = time.monotonic() - begun_s
    run.network.do("boot", "head")
    for host in sorted({host for host, _ in places}):  # what they run knows the former head only
        run.network.do("ray-stop", host)
        run.network.do("ray-start", host)
    begun_s = time.monotonic()
    run.resume()
    learner = before["learner"]

    def is_resumed(roles: dict[str, dict[str, Any]]) -> bool:
        row = roles.get("learner")
        return row is not None and (_host(row), row["pid"]) not in places and _is_at_work(row)

    run.until(is_resumed, "it is resumed")
    run.learns()
    outcome = Outcome(
        HEAD_LOST, "learner", round(time.monotonic() - begun_s, 1), None, round(old_ended_s, 1), run.lease_s,
        learner["host"], run.roles()["learner"]["host"],
    )  # fmt: skip
    print(json.dumps(outcome._asdict()), flush=True)
    return outcome


def _recovery(run: Run, fault: str, role: str, before: dict[str, Any], begun_s: float | None) -> Outcome:
    """Waits until a role works anew, and prints how long it took."""
    now_s = time.monotonic()
    old_ended_s = None if begun_s is None else now_s - begun_s
    begun_s = now_s if begun_s is None else begun_s

    def is_new(roles: dict[str, dict[str, Any]]) -> bool:
        row = roles.get(role)
        is_other = row is not None and (row["pid"], row["host"]) != (before["pid"], before["host"])
        return is_other and row is not None and _is_at_work(row)

    run.until(is_new, f"{role} works anew")
    step = _step(run.roles())
    run.until(lambda roles: _step(roles) > step, "the learner goes on")
    recovered_s, after = time.monotonic() - begun_s, run.roles()[role]
    outcome = Outcome(
        fault, role, round(recovered_s, 1), TARGET_S[fault], None if old_ended_s is None else round(old_ended_s, 1),
        run.lease_s, before["host"], after["host"],
    )  # fmt: skip
    print(json.dumps(outcome._asdict()), flush=True)
    run.learns()
    return outcome


def _is_at_work(row: dict[str, Any]) -> bool:
    """Whether a role's present process has reported lately."""
    age = row["heartbeat_age_s"]
    is_idle = row["state"].startswith(("starting", "waiting to be", "waiting for a place", "waiting for the places"))
    return bool(row["pid"]) and age is not None and age < 3.0 and not is_idle


def _step(roles: dict[str, dict[str, Any]]) -> float:
    return float(roles.get("learner", {}).get("metrics", {}).get("learner_step", 0.0))


def _host(row: dict[str, Any]) -> str:
    """Returns the script's name of the host of a role."""
    return str(row["host"]).rpartition("-")[2]


if __name__ == "__main__":
    main()
