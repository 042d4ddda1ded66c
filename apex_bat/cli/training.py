"""`apex-bat train`."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from apex_bat.config import Config, ConfigError, load

if TYPE_CHECKING:  # `--help` needs none of it
    from apex_bat.launching.course import Ended
    from apex_bat.launching.live import View
    from apex_bat.launching.standing import Origin

_BYTES_A_TRANSITION = 1024  # on the wire, at most: a chunk of one transition brings four frames of 192 bytes along
_ROLES_END_S = 3.0  # beyond their grace, until the roles of a killed launcher are gone
ConfigFile = Annotated[Path | None, typer.Option("--config", help="TOML file of settings; those that ship: configs/.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Change one setting; repeatable. `none` means None."),
]


def train(
    config_file: ConfigFile = None,
    overrides: Overrides = None,
    run: Annotated[
        Path | None, typer.Option("--run", help="Run folder to make. [default: runs/NAME-DATE-TIME]")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="RUN", help="Go on with this run, with its settings or those of --config."),
    ] = None,
    without_replay: Annotated[
        bool, typer.Option("--without-replay", help="With --resume: begin with an empty replay.")
    ] = False,
    serial: Annotated[
        bool, typer.Option("--serial", help="All roles in this process, in lock step: equal seeds give equal bytes.")
    ] = False,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Stream flights and curves to a rerun viewer that is open on this machine.")
    ] = False,
    plain: Annotated[bool, typer.Option("--plain", help="Plain lines instead of the live view.")] = False,
    cluster: Annotated[
        str | None,
        typer.Option("--cluster", metavar="ADDRESS", help="Train on a running Ray cluster: `auto`, or HOST:PORT."),
    ] = None,
) -> int:
    """Train on this machine: actors, replay, learner and evaluator as processes; then evaluate the best checkpoint.

    Ends at the first of train.max_minutes, train.max_env_steps and train.max_updates. Ctrl-C ends it early, with a last
    checkpoint and snapshot; a second Ctrl-C kills.

    With --resume a run goes on: network, optimiser, counters, random states and replay are restored and checked, and
    what was restored is said. A run that had reached its limit needs a higher one: --set train.max_minutes=30. Settings
    that would make another experiment of it are refused. A run begun with --serial goes on to the bit as if it had
    never stopped.
    """
    if resume is not None and run is not None:
        raise typer.BadParameter("--run makes a new run and --resume goes on with one: give one of them")
    if without_replay and resume is None:
        raise typer.BadParameter("--without-replay belongs to --resume")
    if cluster is not None and serial:
        raise typer.BadParameter("--serial runs all roles in this process and --cluster on many: give one of them")
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    console = Console()
    if resume is None:
        folder, config = _create(config_file, overrides or (), run, serial=serial, cluster=cluster)
    else:
        folder, config = resume, _settings_of(resume)
    with locked_run(folder, config) as lock:
        lines: tuple[str, ...] = ()
        origin, part = None, 0
        if resume is not None:
            from apex_bat.launching import resuming

            found = resuming.prepare(folder, config_file, overrides or (), serial=serial, without_replay=without_replay)
            check(found.config, serial=found.mode == "serial", on_cluster=cluster is not None)
            resuming.apply(folder, found, without_replay=without_replay)
            config, serial, lines, origin = found.config, found.mode == "serial", found.lines, found.origin
            part = resuming.num_resumed(folder)
        mode = ", serial" if serial else ""
        title = f"apex-bat train: {config.condition} in {config.arena}, seed {config.seed}{mode}, {folder}"
        for line in (title, *lines):
            console.print(line, highlight=False, soft_wrap=True)
        start = _starter(config, folder, serial=serial, origin=origin, part=part, lock=lock, cluster=cluster)
        if follow(start, folder, title, console, rerun=rerun, plain=plain).outcome == "interrupted":
            typer.echo(
                f"interrupted; the last checkpoint is in {folder / 'checkpoints'}; "
                f"apex-bat train --resume {folder} goes on",
                err=True,
            )
            raise typer.Exit(130)
        conclude(folder, config, console)
    return 0


def _create(
    config_file: Path | None, overrides: Sequence[str], run: Path | None, *, serial: bool, cluster: str | None
) -> tuple[Path, Config]:
    """Makes a new run folder; returns it with its settings."""
    from apex_bat.evaluation import runs

    if cluster is None:
        config = load(config_file, overrides)
    else:
        from apex_bat.launching import ray_cluster

        with ray_cluster.connected(cluster):  # before a folder is made that nothing would run in
            config = load(config_file, overrides, ray_cluster.num_actor_places)
    check(config, serial=serial, on_cluster=cluster is not None)
    folder = run or Path("runs") / f"{config_file.stem if config_file else 'default'}-{datetime.now():%Y%m%d-%H%M%S}"
    runs.create(folder, config, mode="serial" if serial else "asynchronous")
    return folder, config


def _settings_of(run: Path) -> Config:
    """Returns the settings of a run that is to go on."""
    from apex_bat.evaluation.runs import load_config
    from apex_bat.launching.resuming import mode_of

    mode_of(run)  # a folder without run.json holds no run
    return load_config(run)


def locked_run(folder: Path, config: Config) -> AbstractContextManager[int | None]:
    """Locks a run folder, as `launching.lock.locked` says, with patience for the roles of a killed launcher."""
    from apex_bat.launching.lock import locked
    from apex_bat.launching.status import is_launched

    return locked(folder, lambda: is_launched(folder), config.launch.grace_s + _ROLES_END_S)


def _starter(
    config: Config,
    folder: Path,
    *,
    serial: bool,
    origin: Origin | None,
    part: int,
    lock: int | None,
    cluster: str | None,
) -> Callable[[View], Ended]:
    """Returns what trains under a view. Imports nothing yet: a Ctrl-C meanwhile is to be noted as one."""

    def start(view: View) -> Ended:
        from apex_bat.launching.space import warn_if_short

        warn_if_short(config, folder)
        if serial:
            from apex_bat.launching import serial as mode

            return mode.train(config, folder, view, is_resumed=origin is not None)
        from apex_bat.launching.standing import NEW_RUN

        if cluster is not None:
            from apex_bat.launching import ray_cluster

            with ray_cluster.connected(cluster):
                return ray_cluster.train(config, folder, view, origin=origin or NEW_RUN, part=part)
        from apex_bat.launching import local

        return local.train(config, folder, view, origin=origin or NEW_RUN, part=part, lock=lock)

    return start


def follow(
    start: Callable[[View], Ended], folder: Path, title: str, console: Console, *, rerun: bool = False, plain: bool
) -> Ended:
    """Trains, and notes in the run folder how it ended; the caller holds its lock. Exits if the training failed.

    Args:
        start: trains under a view.
        folder: of the run.
        title: of the live view.
        console: what the view is shown on.
        rerun: whether to stream to a viewer.
        plain: whether to print plain lines instead of the live view.
    """
    from apex_bat.evaluation import runs
    from apex_bat.storage import StorageError

    try:
        with _without_leftovers(folder), _streamer(folder) if rerun else nullcontext():
            ended = start(_view(title, console, plain=plain))
    except KeyboardInterrupt:  # while it began; one that comes later ends what `start` follows
        with suppress(StorageError):
            runs.finish(folder, "interrupted", reason="interrupted")
        raise
    except BaseException as error:
        with suppress(StorageError):  # of a full disk, which is then the error at hand
            runs.finish(folder, "failed", reason=str(error) or type(error).__name__)
        raise
    with suppress(StorageError):
        runs.finish(
            folder, ended.outcome, reason=ended.reason, env_steps=ended.env_steps, learner_steps=ended.learner_steps,
            elapsed_s=round(ended.elapsed_s, 3),
        )  # fmt: skip
    if ended.outcome == "failed":
        typer.echo(f"apex-bat: {ended.reason}; the logs are in {folder / 'logs'}", err=True)
        raise typer.Exit(1)
    return ended


def _view(title: str, console: Console, *, plain: bool) -> View:
    from apex_bat.launching.live import PlainView, view_for

    return PlainView(console) if plain else view_for(console, title)


@contextmanager
def _without_leftovers(folder: Path) -> Iterator[None]:
    """Removes what killed processes were writing in a run folder, before the block and after it."""
    from apex_bat.launching.leftovers import remove_leftovers

    remove_leftovers(folder)
    try:
        yield
    finally:
        remove_leftovers(folder)


def _streamer(folder: Path) -> AbstractContextManager[None]:
    from apex_bat.recording.streaming import streamer

    return streamer(folder)


def check(config: Config, *, serial: bool = False, on_cluster: bool = False) -> None:
    """Refuses settings that no role could work with, before anything is started.

    Raises:
        ConfigError, ArenaError, TransportError: they name the setting.
    """
    from apex_bat.agent.inference import parameter_shapes
    from apex_bat.replay.store import limiter_of
    from apex_bat.simulation.arenas import load_arenas
    from apex_bat.transport.security import load_keys
    from apex_bat.transport.sockets import check_address

    if serial:
        from apex_bat.launching.serial import settings_of

        settings_of(config)
    if config.replay.shards > 1 and (serial or on_cluster):
        mode = "a serial run" if serial else "a run on a cluster"
        raise ConfigError(f"replay.shards is {config.replay.shards}, and {mode} has one replay: set it to 1")
    try:
        limiter_of(config)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    _check_inserts(config)
    for arena in dict.fromkeys((config.arena, *config.evaluation.arenas)):
        load_arenas(arena)
    try:
        parameter_shapes(config.network, config.state_steps)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    keys = load_keys(Path(config.transport.keys)) if config.transport.keys else None
    if on_cluster and config.transport.host != "ipc":
        raise ConfigError("transport.host: on a cluster each role listens at its node's address; leave it out")
    if config.transport.host != "ipc":
        check_address(f"tcp://{config.transport.host}:{config.transport.base_port}", keys)


def _check_inserts(config: Config) -> None:
    """Refuses settings with which the largest insert of an actor would be refused again and again."""
    capacity = config.replay.capacity // config.replay.shards
    if capacity < config.largest_insert:
        raise ConfigError(
            f"replay.capacity {config.replay.capacity} is less than the {config.largest_insert} transitions that the "
            f"{config.bats_per_actor} bats of an actor may send at once; give more, or fewer bats_per_actor"
        )
    needed_mb = config.largest_insert * _BYTES_A_TRANSITION / 2**20
    if config.transport.max_message_mb < needed_mb:
        raise ConfigError(
            f"transport.max_message_mb {config.transport.max_message_mb:g} is less than the {needed_mb:.2g} MB that an "
            f"insert of {config.largest_insert} transitions may take"
        )


def conclude(folder: Path, config: Config, console: Console) -> None:
    """Evaluates the best checkpoint of a run, records flights of it, prints the result and where everything is."""
    from apex_bat.evaluation import runs
    from apex_bat.recording.keeping import keep_flights, num_logged
    from apex_bat.storage import write_text

    evaluation, num_first = config.evaluation, config.recording.evaluation_flights
    if not evaluation.arenas:
        return
    console.print(
        f"evaluating the best checkpoint: {evaluation.flights} flights of "
        f"{config.episode.evaluation_steps} steps in {', '.join(evaluation.arenas)}"
    )
    result, flights = runs.evaluate(
        folder, evaluation.arenas, evaluation.flights, evaluation.start_seed,
        num_recorded=num_logged(config.recording, num_first),
    )  # fmt: skip
    print_result(result, console)  # first: a full disk must not cost it
    write_text(folder / "evaluation" / "final.json", json.dumps(result, indent=1) + "\n")
    keep_flights(flights, config, folder, num_first=num_first)
    console.print(f"run folder:  {folder}\nrecordings:  apex-bat inspect {folder}\n"
                  f"pictures:    {folder / 'figures'}", highlight=False, soft_wrap=True)  # fmt: skip


def print_result(result: dict[str, Any], console: Console) -> None:
    """Prints the summary of an evaluation as a table."""
    from rich.markup import escape
    from rich.table import Table

    origin = f"{result['checkpoint']}, update {result['learner_step']}" if result["checkpoint"] else "a baseline"
    title = "; ".join([f"{result['run']}: {result['condition']}, {origin}", *result.get("changed", ())])
    table = Table(title=title, title_justify="left")
    columns = ("arena", "complete", "steps", "distance [m]", "progress [m]", "straight [%]", "clearance [m]")
    for name in columns:
        table.add_column(escape(name), justify="left" if name == "arena" else "right")
    for row in result["summary"]:
        table.add_row(
            row["arena"], f"{row['completed']} of {row['flights']}", f"{row['steps_mean']:.0f}",
            f"{row['distance_m_mean']:.1f}", f"{row['progress_m_mean']:.1f}",
            f"{100 * row['straight_share_mean']:.0f}", f"{row['clearance_m_median']:.2f}",
        )  # fmt: skip
    console.print(table)
