"""The live view of a run: panels in a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
from types import TracebackType
from typing import Protocol

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from apex_bat.launching.standing import Standing
from apex_bat.launching.supervisor import Watched

PLAIN_PERIOD_S = 10.0


class View(Protocol):
    """What shows a run while it lasts."""

    def __enter__(self) -> View:
        """Begins."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends."""

    def show(self, standing: Standing, watched: dict[str, Watched]) -> None:
        """Shows how the run stands now."""


def view_for(console: Console, title: str) -> View:
    """Returns the view that fits the console: panels in a terminal, else plain lines."""
    return TerminalView(console, title) if console.is_terminal else PlainView(console)


class PlainView:
    """A line every ten seconds, for logs and pipes."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._due_s = -math.inf

    def __enter__(self) -> PlainView:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def show(self, standing: Standing, watched: dict[str, Watched]) -> None:
        """Prints a line if the last one is old enough."""
        del watched
        if standing.now_s < self._due_s:
            return
        self._due_s = standing.now_s + PLAIN_PERIOD_S
        parts = [f"{name} {value}" for name, value in figures(standing)]
        self._console.print(", ".join(parts), soft_wrap=True, highlight=False)


class TerminalView:
    """Figures, progress and roles in panels that fit 80 x 24."""

    def __init__(self, console: Console, title: str) -> None:
        self._title = title
        self._live = Live(console=console, refresh_per_second=4, transient=False)

    def __enter__(self) -> TerminalView:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def show(self, standing: Standing, watched: dict[str, Watched]) -> None:
        """Draws the panels anew."""
        self._live.update(
            Group(Panel(self._figures(standing), title=self._title, title_align="left"), _roles(standing, watched))
        )

    @staticmethod
    def _figures(standing: Standing) -> Group:
        table = Table.grid(padding=(0, 2), expand=True)
        for _ in range(3):
            table.add_column(style="dim")
            table.add_column(justify="right")
        rows = figures(standing)
        for i in range(0, len(rows), 3):
            table.add_row(*(cell for pair in rows[i : i + 3] for cell in pair))
        share = max((used / limit for _, used, limit in standing.limits), default=0.0)
        return Group(table, ProgressBar(total=1.0, completed=min(share, 1.0)))


def figures(standing: Standing) -> list[tuple[str, str]]:
    """Returns name and text of each figure of the view, a dash for what is not known yet."""
    replay, learner = standing.roles["replay"], standing.roles["learner"]
    evaluator = standing.roles.get("evaluator")
    left_s = standing.time_left_s
    judged = math.nan if evaluator is None else evaluator.gauge("completed_share")
    return [
        ("env steps", _number(standing.env_steps)),
        ("steps/s", _number(standing.env_steps_per_s)),
        ("episodes", _number(standing.episodes)),
        ("updates", _number(standing.learner_step)),
        ("updates/s", _number(learner.gauge("updates_per_s"), 1)),
        ("loss", _number(learner.gauge("loss"), 5)),
        ("greedy return", _number(standing.recent("return_greedy"), 2)),
        ("return", _number(standing.recent("return"), 2)),
        ("test flights", "-" if math.isnan(judged) else f"{100 * judged:.0f} % complete"),
        ("replay", _number(replay.gauge("replay.size"))),
        ("samples/insert", _number(replay.gauge("replay.samples_per_insert"), 2)),
        ("policy lag", _number(replay.gauge("replay.policy_lag"), 0)),
        ("elapsed", _clock(standing.elapsed_s)),
        ("time left", "-" if left_s is None else _clock(left_s)),
    ]


def _roles(standing: Standing, watched: dict[str, Watched]) -> Table:
    table = Table(expand=True, box=None, pad_edge=False)
    for name in ("role", "pid", "restarts", "heard"):
        table.add_column(name, justify="left" if name == "role" else "right", no_wrap=True)
    table.add_column("doing", ratio=1, no_wrap=True, overflow="ellipsis")
    for row in standing.status(watched):
        age = row["heartbeat_age_s"]
        style = "yellow" if age is None or age > 5.0 else ""
        table.add_row(
            row["role"], str(row["pid"] or "-"), str(row["restarts"]),
            Text("-" if age is None else f"{age:.0f} s", style=style), row["state"],
        )  # fmt: skip
    return table


def _number(value: float | None, decimals: int = 0) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:,.{decimals}f}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
