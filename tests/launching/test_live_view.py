"""The live view fits its terminal."""

import io

import pytest
from rich.console import Console

from apex_bat.config import load
from apex_bat.launching.live import TerminalView
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
