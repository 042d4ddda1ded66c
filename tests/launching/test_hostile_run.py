"""A whole run on a TCP port of this machine, whose three sockets strangers attack from its start to its end."""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq

from apex_bat.roles.plan import Addresses
from apex_bat.transport.messages import Report, encode
from benchmarks.attacks import ON_REPLAY, ON_REPORTS, ON_WEIGHTS, Target
from tests.launching.small_run import SMALL, options

SETTINGS = {
    **SMALL, "evaluation.during_training": "false", "evaluation.flights": "1", "transport.host": "127.0.0.1",
    "transport.max_message_mb": "1.0", "train.max_updates": "400",
}  # fmt: skip


def attack_all(addresses: tuple[str, str, str]) -> None:
    """A process: strangers make every attack on every socket, 20 rounds a second, until they are ended."""
    shots = []
    for address, attacks, kind in zip(
        addresses, (ON_REPLAY, ON_WEIGHTS, ON_REPORTS), (zmq.DEALER, zmq.DEALER, zmq.PUSH), strict=True
    ):
        shots += [make(Target(address, 0, 1 << 20, kind)) for make in attacks.values()]
    forged: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PUSH)
    forged.connect(addresses[2])
    while True:
        for shoot in shots:
            with suppress(OSError):  # a role that is not there yet, or not any more
                shoot()
        with suppress(zmq.Again):
            forged.send(encode(Report("../../forged", 1, "h", "a", "s", {})), zmq.NOBLOCK)
        time.sleep(0.05)


def newest_row(path: Path) -> dict[str, Any]:
    row: dict[str, Any] = json.loads(path.read_text().splitlines()[-1])
    return row


@pytest.mark.slow
def test_a_run_that_strangers_attack_completes_and_counts_them(tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [sys.executable, "-m", "apex_bat", "train", "--run", str(run), *options(SETTINGS)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    attackers = None
    try:
        ends_s = time.monotonic() + 60
        while not (run / "metrics" / "replay.jsonl").exists():
            assert time.monotonic() < ends_s
            assert process.poll() is None
            time.sleep(0.1)
        assert (run / "addresses.json").stat().st_mode & 0o777 == 0o600
        known = msgspec.json.decode((run / "addresses.json").read_bytes(), type=Addresses)
        endpoints = (known.replay, known.weights, known.reports)
        attackers = multiprocessing.get_context("spawn").Process(target=attack_all, args=(endpoints,), daemon=True)
        attackers.start()
        output, _ = process.communicate(timeout=110)
        assert process.returncode == 0, output
    finally:
        if attackers is not None:
            attackers.kill()
            attackers.join()
        process.kill()
        process.wait()
    replay, learner = newest_row(run / "metrics" / "replay.jsonl"), newest_row(run / "metrics" / "learner.jsonl")
    status = json.loads((run / "status.json").read_text())
    assert all(role["restarts"] == 0 for role in status["roles"])
    assert replay["replay.refused"] == 0, "nothing of the run's own actor was refused"
    assert replay["replay.actors"] == 1, "and nothing of a stranger was stored"
    for reason in ("generation", "foreign", "parts", "handshake"):
        assert replay[f"replay.refused_messages.{reason}"] > 0, reason
        assert status["refused_reports"][reason] > 0, reason
        assert learner[f"weights.refused.{reason}"] > 0, reason
    assert not list(tmp_path.rglob("*forged*"))
