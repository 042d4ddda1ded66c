"""Training on this machine: every role a process, watched until a limit is reached, Ctrl-C, or a role is given up."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import FrameType

import msgspec

from apex_bat.config import Config
from apex_bat.launching.course import Course, Ended
from apex_bat.launching.live import View
from apex_bat.launching.processes import Recipe, RoleProcess, has_reserve, threads_of
from apex_bat.launching.standing import NEW_RUN, Origin
from apex_bat.roles.logs import launcher_log
from apex_bat.roles.plan import Addresses, Role, roles_of
from apex_bat.roles.process import ADDRESSES
from apex_bat.storage import write_text
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import TransportError, load_keys

_MAX_IPC_PATH = 90  # a Unix socket's path holds 107 bytes


def train(
    config: Config, run: Path, view: View, *, origin: Origin = NEW_RUN, part: int = 0, lock: int | None = None
) -> Ended:
    """Trains in a run folder made by `runs.create` until a limit, Ctrl-C or a role that is given up.

    Args:
        config: the settings.
        run: the run folder.
        view: shows the run.
        origin: what earlier parts of a resumed run have done.
        part: how often the run was resumed.
        lock: file descriptor of the run's lock, for the roles to keep open.
    """
    with terminable(), launcher_log(run, config.launch), _addresses(config, run) as addresses:
        write_text(run / ADDRESSES, msgspec.json.encode(addresses).decode(), mode=0o600)  # its numbers let one in
        keys = load_keys(Path(config.transport.keys)) if config.transport.keys else None
        collector = ReportCollector(
            addresses.reports,
            keys=keys,
            generation=addresses.reports_generation,
            roles=[role.name for role in roles_of(config)],
        )

        recipes = {role: Recipe(role, run, threads_of(role, config), lock=lock) for role in roles_of(config)}
        with ExitStack() as stack:
            reserves = {
                role: stack.enter_context(closing(recipe.reserve()))
                for role, recipe in recipes.items()
                if has_reserve(role, config)
            }

            newest: dict[Role, RoleProcess] = {}

            def start(role: Role, incarnation: int, flown_steps: int) -> RoleProcess:
                newest[role] = RoleProcess(recipes[role], incarnation, flown_steps, reserve=reserves.get(role))
                return newest[role]

            def tend() -> None:
                for process in newest.values():
                    process.tend_reserve()

            return Course(config, run, collector, start, origin, part, tend=tend).go(view)


def heeded(*names: str) -> list[signal.Signals]:
    """Returns those of some signals that this system has and that this process was not told to ignore.

    What `nohup` or a shell's background sets to be ignored stays ignored.
    """
    numbers: list[signal.Signals] = [getattr(signal, name) for name in names if hasattr(signal, name)]
    return [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]


@contextmanager
def terminable() -> Iterator[None]:
    """Makes SIGTERM and a closed terminal end a run in the same way as Ctrl-C."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = heeded("SIGTERM", "SIGHUP")
    former = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextmanager
def _addresses(config: Config, run: Path) -> Iterator[Addresses]:
    """Yields the endpoints of a run; sockets of `ipc` lie in a folder that only this user can enter.

    Raises:
        TransportError: no port could be had.
    """
    if config.transport.host != "ipc":
        host, base_port = config.transport.host, config.transport.base_port
        number = 2 + config.replay.shards
        ports = [base_port + i for i in range(number)] if base_port else _free_ports(host, number)
        yield _with_generations([f"tcp://{host}:{port}" for port in ports])
        return
    folder = run.resolve() / "sockets"
    if len(os.fsencode(folder)) > _MAX_IPC_PATH:
        folder = Path(tempfile.mkdtemp(prefix="apex_bat-"))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(mode=0o700)
    try:
        further = [f"replay-{number}" for number in range(1, config.replay.shards)]
        yield _with_generations([f"ipc://{folder / name}" for name in ("replay", "weights", "reports", *further)])
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _with_generations(endpoints: Sequence[str]) -> Addresses:
    """Returns the addresses of replay, weights, reports, further replays; with generations that nobody can guess."""
    replay, weights, reports, *further = (secrets.randbits(63) for _ in endpoints)
    return Addresses(
        *endpoints[:3], replay_generation=replay, weights_generation=weights, reports_generation=reports,
        further_replays=tuple(zip(endpoints[3:], further, strict=True)),
    )  # fmt: skip


def _free_ports(host: str, number: int) -> list[int]:
    """Returns ports that are free now; another process could take one before the roles bind them."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for each in sockets:
            try:
                each.bind((host, 0))
            except OSError as error:
                raise TransportError(f"transport.host={host}: cannot listen there: {error.strerror or error}") from None
        return [each.getsockname()[1] for each in sockets]
