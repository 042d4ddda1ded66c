"""A role as a process of its own: logging, leash and exit codes."""

from __future__ import annotations

import ctypes
import faulthandler
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType

from apex_bat.config import Config, ConfigError, load
from apex_bat.replay.snapshot import SnapshotError
from apex_bat.roles.logs import RotatingLog
from apex_bat.roles.orders import ORPHANED_S, StandingOrders, await_life
from apex_bat.roles.plan import Addresses, Assignment, Kind, Role, read_addresses, role_of
from apex_bat.storage import StorageError
from apex_bat.transport.security import AddressInUseError, TransportError

ADDRESSES = "addresses.json"
FAILED, USELESS = 1, 2
INTERRUPTED, TERMINATED = 130, 143
"""Exit codes of a role that somebody else than its launcher ended, by Ctrl-C or SIGTERM: it is started again."""
_PR_SET_PDEATHSIG = 1
_log = logging.getLogger(__name__)


def run_process(
    kind: Kind,
    number: int,
    run: Path,
    incarnation: int,
    leashed: bool,
    flown_steps: int = 0,
    *,
    is_ordered: bool = False,
    in_reserve: bool = False,
) -> int:
    """Runs a role until it is told to stop and returns its exit code.

    Args:
        kind: which role.
        number: which of its kind.
        run: the run folder, with config.toml and, unless the role is ordered, addresses.json.
        incarnation: number of this life of the role, see `plan.incarnation_of`.
        leashed: whether the end of standard input means stop; then the role writes its log itself.
        flown_steps: environment steps of the whole run before this start.
        is_ordered: whether addresses and keys come on standard input, see `roles.orders`; leashed as well.
        in_reserve: whether to import all that the role needs and then wait for standard input to say which life to
            begin, instead of the two numbers above.

    Returns:
        0 when it ended by itself or by its leash, 1 when it failed, 2 when starting it again would fail in the same
        way, 130 and 143 when Ctrl-C or SIGTERM ended it.
    """
    faulthandler.enable()
    role = Role(kind, number)
    logging.basicConfig(level=logging.INFO, format=_line_format(role))
    if in_reserve:
        _be_continued_when_orphaned()
        _entry_of(kind)
        try:
            life = await_life()
        except TransportError as error:
            _log.error("%s", error)
            return FAILED
        if life is None:
            return 0
        incarnation, flown_steps = life.incarnation, life.flown_steps
    stop = threading.Event()
    heard = _hear_signals(stop)
    try:
        config = load(run / "config.toml")
        role = role_of(kind, number, config)
        orders = StandingOrders() if is_ordered else None
        if leashed or is_ordered:
            _write_log(role, run, config)
            hold_leash(stop, config.launch.grace_s, orders)
        _run(_assigned(Assignment(role, config, run, Addresses("", "", ""), stop, incarnation, flown_steps), orders))
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ConfigError, TransportError, StorageError, SnapshotError) as error:
        _log.error("%s", str(error).replace("\n", " "))  # one line, for a person
        is_passing = is_ordered and isinstance(error, AddressInUseError)  # the next life is given another port
        return FAILED if is_passing else USELESS
    except Exception:
        _log.exception("failed")
        return FAILED
    return heard[0] if heard else 0


def _assigned(given: Assignment, orders: StandingOrders | None) -> Assignment:
    """Returns an assignment with its addresses and keys: those ordered, or those of the run folder.

    Raises:
        StorageError, TransportError: there are none.
    """
    if orders is None:
        return given._replace(addresses=read_addresses(given.run / ADDRESSES))
    addresses = orders.first()
    return given._replace(addresses=addresses, moved=orders.moved, given_keys=orders.keys)


def hold_leash(stop: threading.Event, grace_s: float, orders: StandingOrders | None = None) -> None:
    """Watches standard input in a thread: at its end, the role is asked to stop, and ended by force after its grace.

    What comes on standard input before its end are orders. An orphan's grace is `orders.ORPHANED_S` at most.

    The end by force needs nothing of Python, so that a role that is blocked in C code ends too; it leaves in the log
    where the role was. A stopped process is continued by the kernel when its launcher dies (Linux), or it would stay.
    """
    _be_continued_when_orphaned()
    threading.Thread(target=_watch_leash, args=(stop, grace_s, orders), daemon=True).start()


def _watch_leash(stop: threading.Event, grace_s: float, orders: StandingOrders | None) -> None:
    while data := os.read(0, 4096):  # not sys.stdin: its lock, held here, would abort the interpreter's end
        if orders is not None:
            orders.heed(data)
    if orders is not None and orders.is_orphan:
        grace_s = min(grace_s, ORPHANED_S)
    faulthandler.dump_traceback_later(grace_s, exit=True)
    stop.set()


def _be_continued_when_orphaned() -> None:
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)


def _hear_signals(stop: threading.Event) -> list[int]:
    """Makes Ctrl-C and SIGTERM ask the role to stop, so that it saves; a second Ctrl-C breaks that off.

    Returns:
        The exit codes of what was heard, in order; it grows.
    """
    heard: list[int] = []

    def end(number: int, _frame: FrameType | None) -> None:
        stop.set()
        heard.append(INTERRUPTED if number == signal.SIGINT else TERMINATED)
        if number == signal.SIGINT and len(heard) > 1:
            raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    return heard


def _write_log(role: Role, run: Path, config: Config) -> None:
    handler = RotatingLog(run / "logs" / f"{role.name}.log", config.launch, takes_standard=True)
    handler.setFormatter(logging.Formatter(_line_format(role)))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)


def _line_format(role: Role) -> str:
    return f"%(asctime)s {role.name} %(levelname)s %(message)s"


def _entry_of(kind: Kind) -> Callable[[Assignment], None]:
    """Imports and returns what runs a role; each kind imports only what it needs."""
    if kind == "actor":
        from apex_bat.roles.actor import run_actor as run
    elif kind == "replay":
        from apex_bat.roles.replay import run_replay as run
    elif kind == "learner":
        from apex_bat.roles.learner import run_learner as run
    else:
        from apex_bat.roles.evaluator import run_evaluator as run
    return run


def _run(assignment: Assignment) -> None:
    run = _entry_of(assignment.role.kind)
    if assignment.stop.is_set():  # by a leash that ended while it was imported: its replacement may be at work
        return
    _log.info("starts, pid %d", os.getpid())
    run(assignment)
    _log.info("ends")
