"""A role as a process of its own: logging, leash and exit codes."""

from __future__ import annotations

import faulthandler
import logging
import os
import signal
import threading
from pathlib import Path

import msgspec

from apex_bat.config import ConfigError, load
from apex_bat.roles.plan import Addresses, Assignment, Kind, Role
from apex_bat.storage import StorageError
from apex_bat.transport.security import TransportError

ADDRESSES = "addresses.json"
FAILED, USELESS = 1, 2
_log = logging.getLogger(__name__)


def run_process(kind: Kind, number: int, run: Path, incarnation: int, leashed: bool) -> int:
    """Runs a role until it is told to stop and returns its exit code.

    Args:
        kind: which role.
        number: which of its kind.
        run: the run folder, with config.toml and addresses.json.
        incarnation: how often this role was started before in this run.
        leashed: whether the end of standard input means stop.

    Returns:
        0 when it ended as asked, 1 when it failed, 2 when starting it again would fail in the same way.
    """
    faulthandler.enable()
    role = Role(kind, number)
    logging.basicConfig(level=logging.INFO, format=f"%(asctime)s {role.name} %(levelname)s %(message)s")
    stop = threading.Event()
    try:
        config = load(run / "config.toml")
        addresses = msgspec.json.decode((run / ADDRESSES).read_bytes(), type=Addresses)
        signal.signal(signal.SIGTERM, lambda *_: stop.set())
        if leashed:
            threading.Thread(target=_hold_leash, args=(stop, config.launch.grace_s), daemon=True).start()
        _run(Assignment(role, config, run, addresses, stop, incarnation))
    except KeyboardInterrupt:
        return 0
    except (ConfigError, TransportError, StorageError) as error:
        _log.error("%s", str(error).replace("\n", " "))  # one line, for a person
        return USELESS
    except Exception:
        _log.exception("failed")
        return FAILED
    return 0


def _run(assignment: Assignment) -> None:
    """Runs the role; each kind imports only what it needs."""
    if assignment.role.kind == "actor":
        from apex_bat.roles.actor import run_actor as run
    elif assignment.role.kind == "replay":
        from apex_bat.roles.replay import run_replay as run
    elif assignment.role.kind == "learner":
        from apex_bat.roles.learner import run_learner as run
    else:
        from apex_bat.roles.evaluator import run_evaluator as run
    _log.info("starts, pid %d", os.getpid())
    run(assignment)
    _log.info("ends")


def _hold_leash(stop: threading.Event, grace_s: float) -> None:
    """Waits for the end of standard input, then gives the role its grace and ends it by force."""
    while os.read(0, 4096):  # not sys.stdin: its lock, held here, would abort the interpreter's end
        pass
    stop.set()
    timer = threading.Timer(grace_s, os._exit, (FAILED,))
    timer.daemon = True
    timer.start()
