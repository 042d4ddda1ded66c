"""`apex-bat inspect`: look at the recorded flights of a run, of two side by side, or of a run that is under way."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:  # rerun and numpy come along, and `--help` needs neither
    from apex_bat.recording.catalog import Entry

MOST_OPENED = 30
"""Recordings that the viewer is given at once: each takes some ten MB of its memory."""
WIDE = 160
"""Columns of a terminal that has room for everything in the list."""


class ViewName(StrEnum):
    """A layout of the viewer."""

    flight = "flight"
    ear = "ear"
    policy = "policy"
    training = "training"


Out = Path | None
Show = Callable[[Sequence[Path], Path, Path], int]
"""Shows recordings in a layout, with a folder for repaired copies; returns an exit code."""


def inspect(
    runs: Annotated[list[Path], typer.Argument(help="Run folder; or two, to see the same start of both.")],
    flight: Annotated[
        str, typer.Option(help="One flight: best, worst, crash, or its number in the list. [default: all]")
    ] = "",
    condition: Annotated[str, typer.Option(help="Only flights under this condition.")] = "",
    view: Annotated[
        ViewName, typer.Option(help="Layout of the viewer; training: the curves of the run.")
    ] = ViewName.flight,
    web: Annotated[bool, typer.Option("--web", help="In the browser instead of the native viewer.")] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Stream the run to a viewer that is open, until it ends or Ctrl-C.")
    ] = False,
    port: Annotated[int, typer.Option(help="Port on this machine of the viewer that --live streams to.")] = 9876,
    leash: Annotated[bool, typer.Option("--leash", hidden=True)] = False,
    show_list: Annotated[bool, typer.Option("--list", help="List the flights and open nothing.")] = False,
    png: Annotated[Out, typer.Option(help="Draw a flight into this file (or .pdf, .svg), without a viewer.")] = None,
    gif: Annotated[Out, typer.Option(help="Draw a flight as a film, without a viewer.")] = None,
    mp4: Annotated[Out, typer.Option(help="The same in real time; needs the program ffmpeg.")] = None,
    screenshot: Annotated[Out, typer.Option(help="Picture of what the viewer shows; needs Vulkan, no display.")] = None,
    at: Annotated[
        float | None, typer.Option(help="Step of the screenshot. [default: where the viewer begins]", min=0.0)
    ] = None,
    csv: Annotated[Out, typer.Option(help="Write the rows of a flight, one a step.")] = None,
    parquet: Annotated[Out, typer.Option(help="The same as Parquet.")] = None,
) -> None:
    """Open the flight recordings of a run in the rerun viewer, laid out; or list, draw or export them.

    What is drawn or exported is the flight that --flight names, else the best.
    """
    if len(runs) > 2:
        raise typer.BadParameter("one run, or two to see side by side", param_hint="RUNS")
    outputs = {"png": png, "gif": gif, "mp4": mp4, "csv": csv, "parquet": parquet}
    wanted = {kind: path for kind, path in outputs.items() if path is not None}
    if len(runs) == 2 and (wanted or show_list or live or view is ViewName.training):
        raise typer.BadParameter("of two runs only flights can be seen, in the viewer", param_hint="RUNS")
    if live:
        from apex_bat.recording.streaming import stream_run

        if not stream_run(runs[0], port, leash=leash):
            os._exit(0)
        return
    from apex_bat.recording.catalog import choose_flight, list_flights

    show = partial(_show, web=web, screenshot=screenshot, at=at)
    if view is ViewName.training and not (wanted or show_list):
        raise typer.Exit(_open_training(runs[0], show))
    entries = list_flights(runs[0], condition)
    if len(runs) == 2:
        raise typer.Exit(_open_pair(runs, choose_flight(entries, flight or "best"), condition, view, show))
    if wanted:
        _export(choose_flight(entries, flight or "best"), wanted)
    elif show_list:
        _print_table([choose_flight(entries, flight)] if flight else entries, entries)
    else:
        chosen = [choose_flight(entries, flight)] if flight else entries[:MOST_OPENED]
        if len(chosen) < len(entries) and not flight:
            print(f"opening the first {len(chosen)} of {len(entries)} flights; --list shows all, --flight N opens one")
        raise typer.Exit(_open(runs[0], chosen, view, show, with_training=not flight))


def _show(paths: Sequence[Path], layout: Path, folder: Path, *, web: bool, screenshot: Out, at: float | None) -> int:
    """Opens the viewer, or only takes a picture of it."""
    from apex_bat.recording.viewing import open_viewer, whole_copies

    whole = whole_copies(paths, folder)
    if screenshot is None:
        return open_viewer(whole, layout, web=web)
    from apex_bat.recording.screenshots import take_screenshot

    for warning in take_screenshot([*whole, layout], screenshot, at):
        print(warning)
    return 0


def _open_training(run: Path, show: Show) -> int:
    """Opens the curves of a run."""
    from apex_bat.evaluation.runs import load_config
    from apex_bat.recording.blueprints import training_blueprint
    from apex_bat.recording.curves import TRAINING_APPLICATION_ID
    from apex_bat.recording.reading import RecordingError
    from apex_bat.recording.training import TRAINING_RECORDING
    from apex_bat.recording.viewing import save_layout

    path = run / "recordings" / TRAINING_RECORDING
    if not path.exists():
        raise RecordingError(f"{run}: the training was not recorded; see the setting recording.curves")
    with tempfile.TemporaryDirectory() as folder:
        layout = save_layout(training_blueprint(load_config(run)), TRAINING_APPLICATION_ID, Path(folder))
        return show([path], layout, Path(folder))


def _open(run: Path, entries: Sequence[Entry], view: ViewName, show: Show, *, with_training: bool) -> int:
    """Opens recordings; the first entry is shown first."""
    from apex_bat.recording.blueprints import APPLICATION_ID, BLUEPRINTS, list_recordings
    from apex_bat.recording.reading import read_settings
    from apex_bat.recording.training import TRAINING_RECORDING
    from apex_bat.recording.viewing import save_layout

    training = run / "recordings" / TRAINING_RECORDING
    paths = [training] if with_training and training.exists() else []
    paths += [entry.path for entry in reversed(entries)]
    with tempfile.TemporaryDirectory() as folder:
        layout = BLUEPRINTS[view.value](read_settings(entries[0].path).arena)
        layout = list_recordings(layout) if len(paths) > 1 else layout
        return show(paths, save_layout(layout, APPLICATION_ID, Path(folder)), Path(folder))


def _open_pair(runs: Sequence[Path], entry: Entry, condition: str, view: ViewName, show: Show) -> int:
    """Opens a flight of the first run beside the one of the second that began at the same pose."""
    from apex_bat.recording.blueprints import pair_blueprint
    from apex_bat.recording.catalog import list_flights, same_start
    from apex_bat.recording.reading import read_settings
    from apex_bat.recording.viewing import PAIR_APPLICATION_ID, save_layout, write_pair

    other = same_start(entry, list_flights(runs[1], condition))
    names = [f"{run.name} ({each.condition})" for run, each in zip(runs, (entry, other), strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        pair = Path(folder, "pair.rrd")
        write_pair(entry.path, other.path, pair)
        layout = pair_blueprint(read_settings(entry.path).arena, (names[0], names[1]), view.value)
        return show([pair], save_layout(layout, PAIR_APPLICATION_ID, Path(folder)), Path(folder))


def _export(entry: Entry, wanted: dict[str, Path]) -> None:
    from apex_bat.recording.picture import draw_flight, write_gif, write_mp4
    from apex_bat.recording.reading import read_flight, read_settings
    from apex_bat.recording.tables import write_csv, write_parquet

    recorded, arena = read_flight(entry.path), read_settings(entry.path).arena
    drawers = {"png": draw_flight, "gif": write_gif, "mp4": write_mp4}
    writers = {"csv": write_csv, "parquet": write_parquet}
    for kind, path in wanted.items():
        if kind in drawers:
            drawers[kind](recorded, arena, path)
        else:
            writers[kind](recorded, path)
        print(f"{path}: {entry.path.name}")


def _print_table(shown: Sequence[Entry], entries: Sequence[Entry]) -> None:
    """Prints a row a flight; what a narrow terminal has no room for is left out, a pipe gets everything on one line."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDE)
    is_wide = console.width >= WIDE
    table = Table(box=None, padding=(0, 2, 0, 0))
    names = ["flight", "arena", "condition", "steps", "return", "end", "mark"]
    for name in names + (["weights", "progress [m]", "MB"] if is_wide else []):
        table.add_column(
            Text(name), no_wrap=True, justify="left" if name in ("arena", "condition", "end", "mark") else "right"
        )
    table.add_column("file", no_wrap=True, overflow="ellipsis")
    for entry in shown:
        cells = [
            str(entries.index(entry)), entry.arena, entry.condition, str(entry.steps), f"{entry.returned:.2f}",
            entry.end or "broken off", entry.mark or "-",
        ]  # fmt: skip
        if is_wide:
            weights = "-" if entry.checkpoint_step is None else str(entry.checkpoint_step)
            cells += [weights, f"{entry.progress_m:.1f}", f"{entry.path.stat().st_size / 1e6:.1f}"]
        table.add_row(*cells, entry.path.name)
    console.print(table)
