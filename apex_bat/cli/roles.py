"""Commands that run a single role, and the one that makes keys."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:  # numpy and ZeroMQ come along, and `--help` needs neither
    from apex_bat.roles.plan import Kind

Run = Annotated[Path, typer.Option(help="Run folder with config.toml and addresses.json.")]
Number = Annotated[int, typer.Option(help="Which of its kind, from 0.", min=0)]
Incarnation = Annotated[int, typer.Option(help="How often this role was started before in this run.", min=0)]
Leash = Annotated[bool, typer.Option("--leash", help="End when standard input ends.")]


def _command(kind: Kind, text: str) -> Callable[[Path, int, int, bool], int]:
    def run(run: Run, number: Number = 0, incarnation: Incarnation = 0, leash: Leash = False) -> int:
        from apex_bat.roles.process import run_process

        raise typer.Exit(run_process(kind, number, run, incarnation, leash))

    run.__doc__ = text
    return run


COMMANDS: dict[Kind, Callable[[Path, int, int, bool], int]] = {
    "actor": _command("actor", "Run one actor of a run."),
    "replay": _command("replay", "Run the replay server of a run."),
    "learner": _command("learner", "Run the learner of a run."),
    "evaluator": _command("evaluator", "Run the evaluator of a run."),
}


def keys(folder: Annotated[Path, typer.Argument(help="Folder for the keys; it must not hold any yet.")]) -> None:
    """Make CURVE keys for servers and clients, as files that only you can read."""
    from apex_bat.transport.security import make_keys

    make_keys(folder)
    print(f"keys written to {folder}; set transport.keys to this folder on every host of the run")
