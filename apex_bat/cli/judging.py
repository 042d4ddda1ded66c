"""Commands that look at runs and arenas: `evaluate`, `status`, `arena`, `bench`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from apex_bat.cli.options import Overrides

Json = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file, for programs.")]
RunFolder = Annotated[Path, typer.Argument(help="Run folder.")]


def evaluate(
    run: Annotated[Path | None, typer.Argument(help="Run folder; none with --policy.")] = None,
    arenas: Annotated[str, typer.Option(help="Arenas, separated by commas. [default: those of the run]")] = "",
    flights: Annotated[int | None, typer.Option(help="Flights in each. [default: that of the run]", min=1)] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the starts. [default: that of the run]", min=0)] = None,
    record: Annotated[int, typer.Option(help="Flights to record in each arena.", min=0)] = 0,
    policy: Annotated[
        str, typer.Option(help="A baseline instead of a run: random, straight, ild or oracle.", metavar="BASELINE")
    ] = "",
    overrides: Overrides = None,
    json_file: Json = None,
) -> None:
    """Fly the best policy of a run greedily, until 1000 steps or a wall, and print what came of it.

    With --set it flies under other settings than it was trained with, for example --set sonar.rendering=exact; the
    result says which. With --policy and without a run a baseline flies.
    """
    from apex_bat.cli.concluding import print_result
    from apex_bat.config import load
    from apex_bat.evaluation import runs
    from apex_bat.recording.keeping import keep_flights, num_logged
    from apex_bat.simulation.arenas import load_arenas
    from apex_bat.storage import write_text

    if (run is None) != bool(policy):
        raise typer.BadParameter("give a run folder or --policy, one of them", param_hint="RUN")
    if run is None and record:
        raise typer.BadParameter("--record writes to a run folder, and --policy has none")
    if run is not None:
        runs.load_config(run)  # says so where there is no run
    config = load(None if run is None else run / "config.toml", overrides or ())
    chosen = [name.strip() for name in arenas.split(",") if name.strip()] or list(config.evaluation.arenas)
    for name in chosen:
        load_arenas(name)
    num_flights = flights or config.evaluation.flights
    start_seed = config.evaluation.start_seed if seed is None else seed
    if run is None:
        from apex_bat.evaluation.results import Protocol, fly_baseline

        result, recorded = fly_baseline(policy, config, Protocol(tuple(chosen), num_flights, start_seed))
    else:
        result, recorded = runs.evaluate(
            run, chosen, num_flights, start_seed, num_recorded=num_logged(config.recording, record),
            overrides=overrides or (),
        )  # fmt: skip
    print_result(result, Console())  # first: a full disk must not cost it
    text = json.dumps(result, indent=1) + "\n"
    if json_file is not None:
        json_file.write_text(text, encoding="utf-8")
    if run is not None:
        write_text(run / "evaluation" / f"{time.strftime('%Y%m%d-%H%M%S')}.json", text)
        keep_flights(recorded, config, run, num_first=record)


def status(run: RunFolder, json_file: Json = None) -> None:
    """Tell each role's pid, host, restarts, heartbeat, rate, lag, memory, and what it does or waits for."""
    from apex_bat.launching.status import figures, read_status

    content = read_status(run)
    if json_file is not None:
        json_file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    if content["verdict"]:
        print(content["verdict"])
    table = Table("role", "pid", "restarts", escape("heard [s]"), "rate", "lag", "memory", "files", box=None)
    for row in content["roles"]:
        cells = [*(row[key] for key in ("role", "pid", "restarts", "heartbeat_age_s")), *figures(row).values()]
        table.add_row(*("-" if cell is None else str(cell) for cell in cells))
    console = Console()
    console.print(table)
    for row in content["roles"]:
        place = " ".join(part for part in (row["host"], row["address"]) if part)
        text = f" {row['role']}: {row['state']}" + (f" ({place})" if place else "")
        console.print(text, soft_wrap=True, highlight=False, markup=False)


def arena(
    name: Annotated[str, typer.Argument(help="Name of an arena, or a TOML file.")],
    png: Annotated[Path, typer.Option(help="Picture to draw.")] = Path("arena.png"),
) -> None:
    """Draw an arena from above, with its safe starts and clear widths."""
    from apex_bat.simulation.arena_figure import draw_arena
    from apex_bat.simulation.arenas import load_arena

    draw_arena(load_arena(name), png)
    print(f"drawn: {png}")


def bench(
    part: Annotated[
        str,
        typer.Argument(
            help="What to measure: simulation, replay, snapshot, wire, recording, learner, system, scaling, or all but "
            "scaling."
        ),
    ],
    json_file: Json = None,
) -> None:
    """Measure a part of the system on this machine, from a checkout."""
    from apex_bat.evaluation import benches

    records = benches.measure(part)
    table = Table("name", "unit", "median", "min", "max", "runs", box=None)
    for record in records:
        numbers = (f"{record[key]:,.4g}" for key in ("median", "min", "max"))
        table.add_row(record["name"], record["unit"], *numbers, str(record["runs"]))
    Console().print(table)
    if json_file is not None:
        json_file.write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
