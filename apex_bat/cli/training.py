"""`apex-bat train`."""

from __future__ import annotations

import json
import logging
from contextlib import nullcontext, suppress
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from apex_bat.config import Config, ConfigError, load

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
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Stream flights and curves to a rerun viewer that is open on this machine.")
    ] = False,
    plain: Annotated[bool, typer.Option("--plain", help="Plain lines instead of the live view.")] = False,
) -> int:
    """Train on this machine: actors, replay, learner and evaluator as processes; then evaluate the best checkpoint.

    Ends at the first of train.max_minutes, train.max_env_steps and train.max_updates. Ctrl-C ends it early, with a last
    checkpoint and snapshot; a second Ctrl-C kills.
    """
    from apex_bat.evaluation import runs
    from apex_bat.launching import local
    from apex_bat.launching.live import PlainView, view_for
    from apex_bat.recording.streaming import streamer
    from apex_bat.storage import StorageError

    config = load(config_file, overrides or ())
    check(config)
    folder = run or Path("runs") / f"{config_file.stem if config_file else 'default'}-{datetime.now():%Y%m%d-%H%M%S}"
    console = Console()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    runs.create(folder, config)
    title = f"apex-bat train: {config.condition} in {config.arena}, seed {config.seed}, {folder}"
    console.print(title, highlight=False, soft_wrap=True)
    view = PlainView(console) if plain else view_for(console, title)
    try:
        with streamer(folder) if rerun else nullcontext():
            ended = local.train(config, folder, view)
    except BaseException as error:
        with suppress(StorageError):  # of a full disk, which is then the error at hand
            runs.finish(folder, "failed", reason=str(error) or type(error).__name__)
        raise
    with suppress(StorageError):
        runs.finish(
            folder, ended.outcome, reason=ended.reason, env_steps=ended.env_steps, learner_steps=ended.learner_steps
        )
    if ended.outcome == "failed":
        typer.echo(f"apex-bat: {ended.reason}; the logs are in {folder / 'logs'}", err=True)
        raise typer.Exit(1)
    if ended.outcome == "interrupted":
        typer.echo(f"interrupted; the last checkpoint is in {folder / 'checkpoints'}", err=True)
        raise typer.Exit(130)
    conclude(folder, config, console)
    return 0


def check(config: Config) -> None:
    """Refuses settings that no role could work with, before anything is started.

    Raises:
        ConfigError, ArenaError, TransportError: they name the setting.
    """
    from apex_bat.agent.inference import parameter_shapes
    from apex_bat.simulation.arenas import load_arenas
    from apex_bat.transport.security import load_keys
    from apex_bat.transport.sockets import check_address

    if config.replay.shards > 1:
        raise ConfigError(
            f"replay.shards is {config.replay.shards}, and training starts one replay server: set it to 1"
        )
    for arena in dict.fromkeys((config.arena, *config.evaluation.arenas)):
        load_arenas(arena)
    try:
        parameter_shapes(config.network, config.state_steps)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    keys = load_keys(Path(config.transport.keys)) if config.transport.keys else None
    if config.transport.host != "ipc":
        check_address(f"tcp://{config.transport.host}:{config.transport.base_port}", keys)


def conclude(folder: Path, config: Config, console: Console) -> None:
    """Evaluates the best checkpoint of a run, records flights of it, prints the result and where everything is."""
    from apex_bat.evaluation import runs
    from apex_bat.recording.keeping import keep_flights, num_logged

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
    (folder / "evaluation" / "final.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    keep_flights(flights, config, folder, num_first=num_first)
    print_result(result, console)
    console.print(f"run folder:  {folder}\nrecordings:  apex-bat inspect {folder}\n"
                  f"pictures:    {folder / 'figures'}", highlight=False, soft_wrap=True)  # fmt: skip


def print_result(result: dict[str, Any], console: Console) -> None:
    """Prints the summary of an evaluation as a table."""
    from rich.markup import escape
    from rich.table import Table

    title = f"{result['run']}: {result['condition']}, {result['checkpoint']}, update {result['learner_step']}"
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
