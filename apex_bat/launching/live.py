"""The live view of a run: panels in a terminal, plain lines elsewhere."""

from __future__ import annotations

import errno
import math
from contextlib import suppress
from statistics import fmean
from types import TracebackType
from typing import Any, Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from apex_bat.launching.sparklines import History, sparkline
from apex_bat.launching.standing import Standing
from apex_bat.launching.supervisor import Watched

PLAIN_PERIOD_S = 10.0
UNWRITABLE = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EIO}
"""Errors of writing a line that are not worth a run: the disk is full, or the terminal is gone."""
WIDE = 120
"""Columns from which the figures stand in five pairs a row instead of three."""
FIGURES_LINES = 9
ROOMY_LINES = 30
"""Lines below the figures from which there are curves too."""
CURVES = ("greedy return", "test flights [m]", "loss", "mean Q", "steps/s", "updates/s")
"""What the curves show."""


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
        lines = [f"standstill: {standing.stall}"] if standing.stall else []
        lines.append(", ".join(f"{name} {value}" for name, value in figures(standing)))
        try:
            self._console.print("\n".join(lines), soft_wrap=True, highlight=False, markup=False)
        except OSError as error:
            if error.errno not in UNWRITABLE:
                raise


class TerminalView:
    """Figures, progress and roles in panels that fit 80 x 24; with more room, curves of the run so far."""

    def __init__(self, console: Console, title: str) -> None:
        self._console, self._title = console, title
        self._live = Live(console=console, refresh_per_second=4, transient=False)
        self._histories = {name: History() for name in CURVES}
        self.renderable: RenderableType = ""

    def __enter__(self) -> TerminalView:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # the terminal is gone; how the run ended does not depend on it
            self._live.__exit__(kind, error, trace)

    def show(self, standing: Standing, watched: dict[str, Watched]) -> None:
        """Draws the panels anew."""
        for name, value in zip(CURVES, _curve_values(standing), strict=True):
            self._histories[name].take(value, standing.now_s)
        width, height = self._console.size
        stall = Text(f"standstill: {standing.stall.partition(' (')[0]}", style="yellow") if standing.stall else None
        parts: list[RenderableType] = [
            Panel(_figures(standing, width), title=self._title, title_align="left", subtitle=stall)
        ]
        height -= FIGURES_LINES
        if height >= ROOMY_LINES:
            parts.append(Panel(self._curves(width - 4), title="since the start", title_align="left"))
            height -= len(CURVES) + 2
        self.renderable = Group(*parts, _roles(standing, watched, height))
        with suppress(OSError):
            self._live.update(self.renderable)

    def _curves(self, width: int) -> Table:
        table = Table.grid(padding=(0, 2))
        for name, history in self._histories.items():
            values = [value for value in history.values if not math.isnan(value)]
            newest = f"{values[-1]:.4g}" if values else "-"
            table.add_row(Text(name, style="dim"), sparkline(history.values, width - 30), newest)
        return table


def _figures(standing: Standing, width: int) -> Group:
    pairs = 5 if width >= WIDE else 3
    table = Table.grid(padding=(0, 2), expand=True)
    for _ in range(pairs):
        table.add_column(style="dim")
        table.add_column(justify="right")
    rows = figures(standing)
    for i in range(0, len(rows), pairs):
        table.add_row(*(cell for pair in rows[i : i + pairs] for cell in pair))
    share = max((used / limit for _, used, limit in standing.limits), default=0.0)
    return Group(table, ProgressBar(total=1.0, completed=min(share, 1.0)))


def _curve_values(standing: Standing) -> tuple[float, ...]:
    """The figures of `CURVES` now."""
    learner, evaluator = standing.roles["learner"], standing.roles.get("evaluator")
    greedy = standing.recent("return_greedy")
    return (
        math.nan if greedy is None else greedy,
        math.nan if evaluator is None else evaluator.gauge("progress_m"),
        learner.gauge("loss"),
        learner.gauge("q_mean"),
        standing.env_steps_per_s,
        learner.gauge("updates_per_s"),
    )


def figures(standing: Standing) -> list[tuple[str, str]]:
    """Returns name and text of each figure of the view, a dash for what is not known yet."""
    replays = [role for name, role in standing.roles.items() if name.startswith("replay")]
    learner = standing.roles["learner"]
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
        ("replay", _number(sum(replay.gauge("replay.size") for replay in replays))),
        ("samples/insert", _number(fmean(replay.gauge("replay.samples_per_insert") for replay in replays), 2)),
        ("policy lag", _number(fmean(replay.gauge("replay.policy_lag") for replay in replays), 0)),
        ("elapsed", _clock(standing.elapsed_s)),
        ("time left", "-" if left_s is None else _clock(left_s)),
    ]


def _roles(standing: Standing, watched: dict[str, Watched], height: int) -> Table:
    """A row a role; many actors that do the same share one when the lines would not suffice."""
    table = Table(expand=True, box=None, pad_edge=False)
    for name in ("role", "pid", "restarts", "heard"):
        table.add_column(name, justify="left" if name == "role" else "right", no_wrap=True)
    table.add_column("doing", ratio=1)
    rows = standing.status(watched)
    if 2 * len(rows) > height:  # what they do may take two lines
        rows = _joined(rows)
    for row in rows:
        age = row["heartbeat_age_s"]
        style = "yellow" if age is None or age > 5.0 else ""
        table.add_row(
            row["role"], str(row["pid"] or "-"), str(row["restarts"]),
            Text("-" if age is None else f"{age:.0f} s", style=style), row["state"],
        )  # fmt: skip
    return table


def _joined(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows, those of actors that do the same made one, which is as long unheard of as the worst of them."""
    joined: list[dict[str, Any]] = []
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        if row["role"].startswith("actor"):
            groups.setdefault(row["state"].partition(":")[0], []).append(row)
        else:
            joined.append(row)
    for state, alike in groups.items():
        ages = [row["heartbeat_age_s"] for row in alike]
        joined.append(
            {
                "role": f"{len(alike)} actors" if len(alike) > 1 else alike[0]["role"],
                "pid": alike[0]["pid"] if len(alike) == 1 else None,
                "restarts": sum(row["restarts"] for row in alike),
                "heartbeat_age_s": None if None in ages else max(ages),
                "state": state,
            }
        )
    return joined


def _number(value: float | None, decimals: int = 0) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:,.{decimals}f}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
