"""A training run from its lock to the note of how it ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.console import Console

from apex_bat.config import Config

if TYPE_CHECKING:  # `--help` needs none of it
    from apex_bat.launching.course import Ended
    from apex_bat.launching.live import View

_ROLES_END_S = 3.0  # beyond their grace, until the roles of a killed launcher are gone


def locked_run(folder: Path, config: Config) -> AbstractContextManager[int | None]:
    """Locks a run folder, as `launching.lock.locked` says, with patience for the roles of a killed launcher."""
    from apex_bat.launching.lock import locked
    from apex_bat.launching.status import is_launched

    return locked(folder, lambda: is_launched(folder), config.launch.grace_s + _ROLES_END_S)


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
