"""The picture of the contest: completed flights over wall-clock time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apex_bat.evaluation.print_style import NORMAL, PNG_DPI, SMALL, Look, new_figure, plain
from benchmarks.peers.contest import Result
from benchmarks.peers.report import Group, judged
from benchmarks.peers.terms import ENOUGH, ENVIRONMENTS

LOOKS = {
    "apex_bat": (Look("#000000", "-", ""), "o"),
    "tianshou": (Look("#0072b2", "--", ""), "s"),
    "sb3": (Look("#d55e00", "-.", ""), "^"),
    "rllib": (Look("#009e73", ":", ""), "D"),
    "apex_bat_serial": (Look("#cc79a7", (0, (6, 2)), ""), "v"),
    "apex_bat_bare": (Look("#e69f00", (0, (3, 1, 1, 1)), ""), "P"),
}
"""Okabe and Ito's colours; dashes and marks tell the lines apart in grey."""
GRID_S = 5.0
NUM_MARKS = 8
NUM_FLIGHTS = 15


def on_grid(result: Result, grid_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the completed flights at some times: between judgements they are taken to change evenly."""
    points = judged(result)
    walls_s = [0.0, *(point["wall_s"] for point in points)]
    return np.asarray(np.interp(grid_s, walls_s, [0.0, *(point["completed"] for point in points)]))


def draw(all_groups: Sequence[Group], path: Path) -> None:
    """Writes the picture, PNG: a panel for each environment; apex_bat is in both."""
    environments = [name for name in ENVIRONMENTS if any(group.environment == name for group in all_groups)]
    figure = new_figure(3.7 * len(environments) + 0.2, 3.2)
    for panel, environment in enumerate(environments):
        axes = figure.add_subplot(1, len(environments), panel + 1)
        for group in all_groups:
            if group.environment != environment and group.entry != "apex_bat":
                continue
            look, mark = LOOKS[group.entry]
            grid_s = np.arange(0.0, group.budget_s + GRID_S, GRID_S)
            curves = np.stack([on_grid(result, grid_s) for result in group.results])
            every = max(1, len(grid_s) // NUM_MARKS)
            axes.fill_between(grid_s, curves.min(axis=0), curves.max(axis=0), color=look.colour, alpha=0.15, lw=0)
            axes.plot(
                grid_s, np.median(curves, axis=0), color=look.colour, ls=look.dashes, lw=1.6, label=group.label,
                marker=mark, ms=4.5, markevery=every,
            )  # fmt: skip
        axes.axhline(ENOUGH, color="0.5", lw=0.8, ls=(0, (1, 2)))
        axes.set_ylim(-0.4, NUM_FLIGHTS + 0.4)
        axes.set_yticks([0, 5, 10, ENOUGH])
        axes.set_xlim(left=0.0)
        plain(axes, f"{environment} environment", "wall-clock time since the command [s]",
              f"flights completed, of {NUM_FLIGHTS}" if panel == 0 else "")  # fmt: skip
        axes.title.set_fontsize(NORMAL)
    handles = {
        str(line.get_label()): line for axes in figure.axes for line in axes.lines if line.get_marker() != "None"
    }
    figure.legend(
        list(handles.values()),
        list(handles),
        fontsize=SMALL,
        frameon=False,
        loc="outside upper center",
        ncols=2 if len(figure.axes) == 1 else 6,
    )
    figure.savefig(path, dpi=2 * PNG_DPI, metadata={"Software": None})
