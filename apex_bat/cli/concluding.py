"""What comes after training: the best checkpoint is judged, and the result printed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from apex_bat.config import Config


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
