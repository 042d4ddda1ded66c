"""Commands that look at runs and arenas: `evaluate`, `status`, `arena`, `bench`."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

Json = Annotated[Path | None, typer.Option("--json", help="Write the figures to this file, for programs.")]
RunFolder = Annotated[Path, typer.Argument(help="Run folder.")]


def evaluate(
    run: RunFolder,
    arenas: Annotated[str, typer.Option(help="Arenas, separated by commas. [default: those of the run]")] = "",
    flights: Annotated[int | None, typer.Option(help="Flights in each. [default: that of the run]", min=1)] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the starts. [default: that of the run]", min=0)] = None,
    record: Annotated[int, typer.Option(help="Flights to record in each arena.", min=0)] = 0,
    json_file: Json = None,
) -> None:
    """Fly the best policy of a run greedily, until 1000 steps or a wall, and print what came of it."""
    from apex_bat.cli.training import print_result
    from apex_bat.evaluation import runs
    from apex_bat.recording.keeping import keep_flights, num_logged
    from apex_bat.simulation.arenas import load_arenas

    config = runs.load_config(run)
    chosen = [name.strip() for name in arenas.split(",") if name.strip()] or list(config.evaluation.arenas)
    for name in chosen:
        load_arenas(name)
    result, recorded = runs.evaluate(
        run, chosen, flights or config.evaluation.flights,
        config.evaluation.start_seed if seed is None else seed, num_recorded=num_logged(config.recording, record),
    )  # fmt: skip
    text = json.dumps(result, indent=1) + "\n"
    (run / "evaluation" / f"{time.strftime('%Y%m%d-%H%M%S')}.json").write_text(text, encoding="utf-8")
    if json_file is not None:
        json_file.write_text(text, encoding="utf-8")
    keep_flights(recorded, config, run, num_first=record)
    print_result(result, Console())


def status(run: RunFolder, json_file: Json = None) -> None:
    """Tell each role's pid, host, address, restarts, heartbeat and what it does or waits for."""
    from apex_bat.evaluation.runs import RunError

    path = run / "status.json"
    if not path.exists():
        raise RunError(f"{run}: no status.json; no run was started here")
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    age_s = time.time() - content["written_unix_s"]
    for row in content["roles"]:
        if row["heartbeat_age_s"] is not None:
            row["heartbeat_age_s"] = round(row["heartbeat_age_s"] + age_s, 2)
    if json_file is not None:
        json_file.write_text(json.dumps({"roles": content["roles"]}, indent=1) + "\n", encoding="utf-8")
    table = Table("role", "pid", "host", "restarts", "heard [s]", "doing", "address", box=None)
    for row in content["roles"]:
        cells = (row[key] for key in ("role", "pid", "host", "restarts", "heartbeat_age_s", "state", "address"))
        table.add_row(*("-" if cell in (None, "") else str(cell) for cell in cells))
    Console().print(table)


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
        str, typer.Argument(help="What to measure: simulation, replay, wire, recording, learner, system, or all.")
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
