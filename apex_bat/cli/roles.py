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
Incarnation = Annotated[int, typer.Option(help="Number of this life of the role; no other has had it.", min=0)]
Flown = Annotated[int, typer.Option(help="Environment steps of the whole run before this start.", min=0)]
Leash = Annotated[bool, typer.Option("--leash", help="End when standard input ends.")]
Reserved = Annotated[
    bool,
    typer.Option("--reserve", help="Import all, then wait for standard input to say which life to begin, or to end."),
]
Ordered = Annotated[
    bool, typer.Option("--orders", help="Take addresses and keys from standard input, and end when it ends.")
]


def _command(kind: Kind, text: str) -> Callable[[Path, int, int, bool, int, bool, bool], int]:
    def run(
        run: Run,
        number: Number = 0,
        incarnation: Incarnation = 0,
        leash: Leash = False,
        flown: Flown = 0,
        orders: Ordered = False,
        reserve: Reserved = False,
    ) -> int:
        from apex_bat.roles.process import run_process

        raise typer.Exit(
            run_process(kind, number, run, incarnation, leash, flown, is_ordered=orders, in_reserve=reserve)
        )

    run.__doc__ = text
    return run


COMMANDS: dict[Kind, Callable[[Path, int, int, bool, int, bool, bool], int]] = {
    "actor": _command("actor", "Run one actor of a run."),
    "replay": _command("replay", "Run the replay server of a run."),
    "learner": _command("learner", "Run the learner of a run."),
    "evaluator": _command("evaluator", "Run the evaluator of a run."),
}


def keys(
    folder: Annotated[Path, typer.Argument(help="Folder for the keys; it must not hold any yet, but with --client.")],
    client: Annotated[
        Path | None,
        typer.Option(help="Folder for the keys of a further client, which the server of the first folder will let in."),
    ] = None,
) -> None:
    """Make CURVE keys for servers and clients, as files that only you can read."""
    from apex_bat.transport.security import make_client_keys, make_keys

    if client is None:
        make_keys(folder)
        print(f"keys written to {folder}; set transport.keys to this folder on every host of the run")
    else:
        make_client_keys(folder, client)
        print(f"keys of a further client written to {client}; a run that starts from now on lets it in")
