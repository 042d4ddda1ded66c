"""`apex-bat train`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from apex_bat.cli.checking import check
from apex_bat.cli.concluding import conclude
from apex_bat.cli.following import follow, locked_run
from apex_bat.cli.options import ConfigFile, Overrides
from apex_bat.config import Config, load
from apex_bat.config.loading import places_anywhere, places_here

if TYPE_CHECKING:  # `--help` needs none of it
    from apex_bat.launching.course import Ended
    from apex_bat.launching.live import View
    from apex_bat.launching.standing import Origin


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
        config = load(config_file, overrides, places_anywhere if serial else places_here)
    else:
        from apex_bat.launching.cluster import ray_cluster

        with ray_cluster.connected(cluster):  # before a folder is made that nothing would run in
            config = load(config_file, overrides, ray_cluster.num_actor_places, can_grow=True)
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
            from apex_bat.launching.cluster import ray_cluster

            with ray_cluster.connected(cluster):
                return ray_cluster.train(config, folder, view, origin=origin or NEW_RUN, part=part)
        from apex_bat.launching import local

        return local.train(config, folder, view, origin=origin or NEW_RUN, part=part, lock=lock)

    return start
