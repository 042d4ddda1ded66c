"""The live view fits its terminal."""

import errno
import io
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import Console

from apex_bat.config import load
from apex_bat.launching.live import PlainView, TerminalView
from apex_bat.launching.standing import Standing
from apex_bat.launching.supervisor import Watched
from apex_bat.roles.plan import roles_of
from apex_bat.transport.messages import Report


def shown(width: int, height: int, actors: int) -> list[str]:
    """The lines of the view of a run after a minute."""
    config = load(None, [f"actors={actors}"])
    standing = Standing(config, now_s=0.0)
    watched = {role.name: Watched(role) for role in roles_of(config)}
    file = io.StringIO()
    console = Console(width=width, height=height, force_terminal=True, file=file, color_system=None)
    view = TerminalView(console, "apex-bat train")
    for second in range(1, 60):
        standing.now_s = float(second)
        for name in watched:
            standing.take(
                Report(name, 1, "here", "", "flying", {"env_steps": 10.0 * second, "loss": 0.1}), float(second)
            )
        view.show(standing, watched)
    with console.capture() as capture:
        console.print(view.renderable)
    return capture.get().splitlines()


@pytest.mark.parametrize(("width", "height", "actors"), [(80, 24, 2), (80, 24, 64), (160, 50, 2), (160, 50, 64)])
def test_view_fits_and_names_every_role(width: int, height: int, actors: int) -> None:
    lines = shown(width, height, actors)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    for name in ("replay", "learner", "evaluator", "actors" if actors > 2 else "actor-1"):
        assert name in text
    assert "…" not in text


def test_wide_terminal_shows_curves() -> None:
    assert any("▁" in line and "loss" in line for line in shown(160, 50, 2))
    assert not any("▁" in line for line in shown(80, 24, 2))


@pytest.mark.parametrize("width", [80, 160])
def test_a_standstill_is_shown_and_fits(width: int) -> None:
    config = load(None, [])
    standing = Standing(config, now_s=0.0)
    standing.now_s = 75.0
    watched = {role.name: Watched(role) for role in roles_of(config)}
    standing.look(watched)
    console = Console(width=width, height=24, force_terminal=True, file=io.StringIO(), color_system=None)
    view = TerminalView(console, "apex-bat train")
    view.show(standing, watched)
    with console.capture() as capture:
        console.print(view.renderable)
    assert "standstill: no environment step and no update for 75 s" in capture.get()
    assert max(map(len, capture.get().splitlines())) <= width

    plain = io.StringIO()
    PlainView(Console(file=plain)).show(standing, watched)
    assert "learner: waiting to be started" in plain.getvalue()


class Gone(io.StringIO):
    """A terminal that is closed meanwhile."""

    is_closed = False

    def write(self, text: str) -> int:
        if self.is_closed:
            raise OSError(errno.EIO, "Input/output error")
        return super().write(text)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # of the thread that redraws
@pytest.mark.parametrize("is_interrupted", [False, True])
def test_a_terminal_that_is_closed_does_not_change_how_the_run_ends(is_interrupted: bool) -> None:
    config, file = load(None, []), Gone()
    standing, watched = Standing(config, now_s=0.0), {role.name: Watched(role) for role in roles_of(config)}
    view, end = TerminalView(Console(force_terminal=True, file=file), "apex-bat train"), ""
    try:
        with view:
            view.show(standing, watched)
            file.is_closed = True
            view.show(standing, watched)
            if is_interrupted:
                raise KeyboardInterrupt  # as SIGHUP does
            end = "completed"
    except KeyboardInterrupt:
        end = "interrupted"
    except OSError:
        end = "failed"
    assert end == ("interrupted" if is_interrupted else "completed")


def test_plain_lines_to_a_terminal_that_is_closed_do_not_end_the_run() -> None:
    file, is_through = Gone(), False
    file.is_closed = True
    with suppress(OSError):
        PlainView(Console(file=file)).show(Standing(load(None, []), now_s=0.0), {})
        is_through = True
    assert is_through


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_plain_lines_in_a_file_on_a_full_disk_do_not_end_the_run() -> None:
    standing, is_through = Standing(load(None, []), now_s=0.0), False
    with suppress(OSError), Path("/dev/full").open("w") as full:
        PlainView(Console(file=full)).show(standing, {})
        is_through = True
    assert is_through
