"""The command line, `apex-bat`: every command in one list. Heavy imports happen inside the commands.

Exit codes: 0 success, 1 a failed run, 2 wrong usage, 130 interrupted; errors are one line on standard error.
"""

from __future__ import annotations

import os
import sys

import typer

from apex_bat import __version__
from apex_bat.cli import adjusting, inspecting, judging, reproducing, roles, training
from apex_bat.config import ConfigError
from apex_bat.launching import ONE_THREAD

_USAGE_ERROR = typer.BadParameter.__mro__[2]  # the class of all usage errors, which typer does not export

app = typer.Typer(
    name="apex-bat",
    help="Train an artificial bat that flies by its echoes, on many processes (Ape-X), and look at how it flies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("train")(training.train)
app.command("evaluate")(judging.evaluate)
app.command("reproduce")(reproducing.reproduce)
app.command("inspect")(inspecting.inspect)
app.command("status")(judging.status)
app.command("adjust")(adjusting.adjust)
app.command("arena")(judging.arena)
app.command("bench")(judging.bench)
app.command("keys")(roles.keys)
for _kind in roles.COMMANDS:
    app.command(_kind)(roles.COMMANDS[_kind])


@app.callback(invoke_without_command=True)
def _version(version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    if version:
        print(f"apex-bat {__version__}")
        raise typer.Exit


def main() -> int:
    """Runs a command and returns its exit code; known errors are printed as one line."""
    for name in ONE_THREAD:  # before numpy is imported: idle BLAS threads that spin halve the simulation's rate
        os.environ.setdefault(name, "1")
    try:
        result = app(standalone_mode=False)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        return _report(error)
    return result if isinstance(result, int) else 0


def _report(error: Exception) -> int:
    """Prints a known error as one line and returns the exit code; an unknown one goes on as a traceback."""
    from apex_bat.storage import StorageError

    if isinstance(error, typer.Abort):
        return 130
    if isinstance(error, _USAGE_ERROR):
        error.show()  # type: ignore[attr-defined]
        return 2
    if isinstance(error, ConfigError):
        return _line(error, 2)
    known = {
        "ArenaError": 2,
        "TransportError": 1,
        "ClusterError": 1,
        "RunError": 1,
        "InUseError": 1,
        "RecordingError": 1,
        "FilmError": 1,
        "ScreenshotError": 1,
        "SnapshotError": 1,
    }  # by name: their modules need not be installed
    if isinstance(error, StorageError):
        return _line(error, 1)
    for kind in type(error).__mro__:
        if kind.__name__ in known and kind.__module__.startswith("apex_bat."):
            return _line(error, known[kind.__name__])
    if isinstance(error, OSError) and error.filename:
        return _line(OSError(f"{error.filename}: {error.strerror}"), 1)
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("apex_bat"):
        extra = "cluster" if error.name == "ray" else "train"
        print(f"apex-bat: {error.name} is not installed; pip install 'apex-bat[{extra}]' brings it", file=sys.stderr)
        return 1
    raise error


def _line(error: Exception, code: int) -> int:
    print("apex-bat: " + str(error).replace("\n", " "), file=sys.stderr)
    return code
