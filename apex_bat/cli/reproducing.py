"""`apex-bat reproduce`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from apex_bat.cli.checking import check
from apex_bat.cli.following import follow, locked_run
from apex_bat.cli.options import ConfigFile, Overrides
from apex_bat.config import Config, ConfigError, load

if TYPE_CHECKING:  # `--help` needs none of it
    from apex_bat.evaluation.reproduction import Planned
    from apex_bat.evaluation.results import Protocol

DEFAULT_BUDGET = 180_000
"""Environment steps of a training: what `apex-bat train --config configs/memory.toml` does in its 11 minutes."""


def reproduce(
    runs: Annotated[list[Path] | None, typer.Argument(help="With --from: the run folders to report on.")] = None,
    seeds: Annotated[int, typer.Option(help="Seeds to train each condition from.", min=1)] = 3,
    conditions: Annotated[str, typer.Option(help="Conditions, separated by commas.")] = "memory,no_memory,onset",
    budget: Annotated[int, typer.Option(help="Environment steps of each training.", min=1)] = DEFAULT_BUDGET,
    folder: Annotated[Path, typer.Option(help="Folder of the campaign; one that was cut short goes on.")] = Path(
        "runs/reproduction"
    ),
    report: Annotated[
        Path | None, typer.Option(help="Folder of the report. [default: FOLDER/report; with --from: report]")
    ] = None,
    arenas: Annotated[str, typer.Option(help="Arenas to judge in, separated by commas.")] = "simple,narrow,circle",
    from_runs: Annotated[bool, typer.Option("--from", help="Train nothing; report on RUNS.")] = False,
    config_file: ConfigFile = None,
    overrides: Overrides = None,
    plain: Annotated[bool, typer.Option("--plain", help="Plain lines instead of the live view.")] = False,
) -> int:
    """Repeat the thesis's experiment: train all conditions from several seeds, judge them, write a report.

    Each condition is trained from each seed for the same environment steps at the same samples per insert, and flown in
    each arena from the same starts, like the baselines. REPORT/index.html and report.md say what came of it: each
    number of the thesis beside ours with a verdict, tables, figures, method. Interrupted, also by a kill, the same
    command goes on; a training that was cut off begins anew.
    """
    from apex_bat.evaluation import reproduction
    from apex_bat.evaluation.report import write_report
    from apex_bat.evaluation.runs import load_config

    if from_runs != bool(runs):
        raise typer.BadParameter("--from and run folders belong together", param_hint="--from RUNS")
    if runs and (config_file or overrides):
        raise typer.BadParameter("--config and --set change trainings, and with --from there are none")
    console = Console()
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")

    def say(line: str) -> None:
        console.print(line, highlight=False, soft_wrap=True, markup=False)

    if runs:
        folders, into = list(runs), report or Path("report")
        protocol = _protocol(arenas, load_config(folders[0]))
        baselines = into / "baselines"
    else:
        reproduction.refuse_limits(overrides or ())
        config = load(config_file, overrides or ())
        protocol = _protocol(arenas, config)
        planned = reproduction.plan(folder, config, _split(conditions), seeds, budget)
        for each in planned:
            check(each.config)
        reproduction.begin(folder, planned)
        if not reproduction.train_all(planned, lambda each, title: _train(each, title, console, plain=plain), say):
            typer.echo(f"interrupted; the same command goes on in {folder}", err=True)
            raise typer.Exit(130)
        folders, into, baselines = [each.folder for each in planned], report or folder / "report", folder / "baselines"
    judged, flown = reproduction.judge_all(folders, baselines, protocol, say)
    say("writing the report")
    for path in write_report(judged, flown, protocol, into):
        say(str(path))
    return 0


def _split(names: str) -> list[str]:
    return [name.strip() for name in names.split(",") if name.strip()]


def _protocol(arenas: str, config: Config) -> Protocol:
    """Returns how policies are judged: flights and starts as the settings say."""
    from apex_bat.evaluation.results import Protocol
    from apex_bat.simulation.arenas import load_arenas

    names = _split(arenas)
    if not names or len(set(names)) < len(names):
        raise ConfigError("--arenas: name at least one arena, and each once")
    for name in names:
        if len(load_arenas(name)) > 1:
            raise ConfigError(f"--arenas {name}: one arena at a time; name each")
    return Protocol(tuple(names), config.evaluation.flights, config.evaluation.start_seed)


def _train(each: Planned, title: str, console: Console, *, plain: bool) -> bool:
    """Makes one training of a campaign; returns False when it was interrupted, and exits when it failed."""
    from apex_bat.evaluation import reproduction, runs
    from apex_bat.launching import local

    title = f"apex-bat reproduce: {title}"
    console.print(title, highlight=False, soft_wrap=True)
    each.folder.mkdir(parents=True, exist_ok=True)
    with locked_run(each.folder, each.config) as lock:
        if each.standing == "trained":  # by another process, which held the lock until now
            return True
        reproduction.clear(each.folder)
        runs.create(each.folder, each.config)
        ended = follow(
            lambda view: local.train(each.config, each.folder, view, lock=lock),
            each.folder, title, console, plain=plain,
        )  # fmt: skip
    return ended.outcome == "completed"
