"""The figures of the thesis's chapter 4, from the data of runs: learning curves, trajectories, how the bats fly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apex_bat.evaluation.groups import Group
from apex_bat.evaluation.print_style import (
    ACTION_HATCHES,
    ACTION_HEX,
    NORMAL,
    SMALL,
    STAR_COLOUR,
    Look,
    looks_of,
    new_figure,
    plain,
)
from apex_bat.evaluation.results import Judged
from apex_bat.recording.flight import ACTION_NAMES
from apex_bat.recording.outlines import arena_extent_m
from apex_bat.recording.panels import draw_walls
from apex_bat.simulation.arenas import load_arena

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

NUM_GRID = 60
MOST_SAMPLES = 20_000
"""Steps whose clearance a violin is made of; more do not change its form."""
VIOLIN_TOP_M = 1.4


def learning_curves(groups: Sequence[Group]) -> Figure:
    """Fig. 4.1: how the judged checkpoints fared over the environment steps; thin lines are runs, bands 95 %."""
    figure = new_figure(9.0, 3.4)
    left, right = figure.subplots(1, 2)
    looks = looks_of([each.label for each in groups])
    for each in groups:
        curves = [run.curve for run in each.runs if run.curve is not None]
        look = looks[each.label]
        for axes, rows in (
            (left, [(curve.env_steps, 100.0 * curve.completed_share) for curve in curves]),
            (right, [(curve.env_steps, curve.progress_m) for curve in curves]),
        ):
            _draw_curves(axes, rows, each.label, look)
    plain(left, "flights completed", "environment steps", "%")
    plain(right, "way along the corridor", "environment steps", "m")
    left.set_ylim(-3.0, 103.0)
    for axes in (left, right):
        axes.ticklabel_format(axis="x", style="plain")
        axes.locator_params(axis="x", nbins=5)
        axes.set_xlim(left=0.0)
    if left.lines:
        left.legend(fontsize=SMALL, frameon=False)
    return figure


def mean_curve(rows: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats, Floats | None]:
    """Returns steps (n,), the mean over seeds (n,) and its bootstrap 95 % band (2, n), None for fewer than three.

    Args:
        rows: steps and values of each seed. The grid runs where every seed has values.
    """
    first, last = max(steps[0] for steps, _ in rows), min(steps[-1] for steps, _ in rows)
    grid = np.linspace(first, max(first, last), NUM_GRID)
    values = np.array([np.interp(grid, steps, value) for steps, value in rows])
    if len(values) < 3:
        return grid, values.mean(axis=0), None
    draws = np.random.default_rng(0).integers(len(values), size=(1000, len(values)))
    return grid, values.mean(axis=0), np.percentile(values[draws].mean(axis=1), [2.5, 97.5], axis=0)


def trajectories(groups: Sequence[Group], arenas: Sequence[str]) -> Figure:
    """Fig. 4.2: all flights of the first seed of each condition in each arena; stars are collisions."""
    figure = new_figure(3.1 * len(arenas), 3.1 * len(groups))
    grid = figure.subplots(len(groups), len(arenas), squeeze=False)
    looks = looks_of([each.label for each in groups])
    for row, each in zip(grid, groups, strict=True):
        for axes, arena in zip(row, arenas, strict=True):
            _draw_flights(axes, each.runs[0], arena, looks[each.label])
            done = [record.completed for record, _ in each.runs[0].of_arena(arena)]
            axes.set_title(f"{each.label}, {arena}: {sum(done)} of {len(done)}", loc="left", fontsize=NORMAL)
    return figure


def behaviour(groups: Sequence[Group], arenas: Sequence[str]) -> Figure:
    """Fig. 4.3: distances to the nearest wall, shares of actions, and distance flown, by condition and arena."""
    figure = new_figure(max(5.0, 1.1 + 0.4 * len(groups) * len(arenas)), 7.6)
    grid = figure.subplots(3, len(arenas), squeeze=False, sharey="row")
    looks = looks_of([each.label for each in groups])
    for column, arena in enumerate(arenas):
        _draw_violins(grid[0, column], groups, arena, looks)
        _draw_shares(grid[1, column], groups, arena)
        _draw_distances(grid[2, column], groups, arena, looks)
        for axes in grid[:, column]:
            axes.set_xticks(range(len(groups)), [each.label for each in groups], rotation=40, ha="right")
        for axes in grid[:2, column]:
            axes.tick_params(labelbottom=False)
    for axes, words in zip(
        grid[:, 0], ("distance to the nearest wall (m)", "share of actions (%)", "distance flown (m)"), strict=True
    ):
        axes.set_ylabel(words, fontsize=SMALL)
    handles, labels = grid[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=SMALL, frameon=False)
    return figure


def _draw_curves(axes: Axes, rows: Sequence[tuple[Floats, Floats]], label: str, look: Look) -> None:
    if not rows:
        return
    for steps, values in rows:
        axes.plot(steps, values, ".", color=look.colour, linestyle=look.dashes, linewidth=0.6, markersize=4, alpha=0.6)
    if len(rows) == 1:
        axes.lines[-1].set(linewidth=2.0, alpha=1.0, markersize=7, label=f"{label}, 1 run")
        return
    grid, middle, band = mean_curve(rows)
    axes.plot(grid, middle, color=look.colour, linestyle=look.dashes, linewidth=2.0, label=f"{label}, {len(rows)} runs")
    if band is not None:
        axes.fill_between(grid, *band, color=look.colour, alpha=0.18, linewidth=0.0)


def _draw_flights(axes: Axes, run: Judged, name: str, look: Look) -> None:
    from matplotlib.collections import LineCollection

    arena = load_arena(name)
    draw_walls(axes, arena)
    flights = run.of_arena(name)
    ways = [trace.poses[:, :2] for _, trace in flights]
    # As pixels in the SVG too: 15 flights of 1000 steps would be megabytes of path.
    axes.add_collection(LineCollection(ways, colors=look.colour, linewidths=0.5, alpha=0.6, rasterized=True))
    starts = np.array([way[0] for way in ways])
    axes.plot(*starts.T, "o", markersize=2.5, color="white", markeredgecolor="black", markeredgewidth=0.6)
    ends = np.array([trace.poses[-1, :2] for record, trace in flights if record.collided]).reshape(-1, 2)
    axes.plot(*ends.T, "*", markersize=10, color=STAR_COLOUR, markeredgecolor="white", markeredgewidth=0.5, zorder=5)
    extent = arena_extent_m(arena)
    below = extent.y_min - 0.12 * (extent.y_max - extent.y_min)
    axes.set(xlim=(extent.x_min - 0.2, extent.x_max + 0.2), ylim=(below, extent.y_max + 0.1), aspect="equal")
    axes.set_axis_off()
    height = (below + extent.y_min) / 2
    axes.plot([extent.x_min, extent.x_min + 1.0], [height, height], color="black", linewidth=2.5, solid_capstyle="butt")
    axes.text(extent.x_min + 1.15, height, "1 m", va="center", fontsize=SMALL)


def _draw_violins(axes: Axes, groups: Sequence[Group], arena: str, looks: dict[str, Look]) -> None:
    generator = np.random.default_rng(0)
    for place, each in enumerate(groups):
        parts = [trace.clearance_m for run in each.runs for _, trace in run.of_arena(arena)]
        values = np.concatenate(parts)
        values = generator.choice(values, MOST_SAMPLES) if len(values) > MOST_SAMPLES else values
        look = looks[each.label]
        if len(values) > 1 and values.std() > 0.0:
            bodies: Any = axes.violinplot(values, [place], widths=0.85, showextrema=False, points=80)["bodies"]
            bodies[0].set(facecolor=look.colour, edgecolor="black", alpha=0.9, linewidth=0.6, hatch=look.hatch)
        low, middle, high = np.percentile(values, [25, 50, 75])
        axes.vlines(place, low, high, color="black", linewidth=2.5)
        axes.plot(place, middle, "o", color="white", markeredgecolor="black", markersize=4)
    axes.axhline(groups[0].runs[0].config.episode.near_m, color="black", linewidth=0.6, linestyle=":")
    plain(axes, arena)
    axes.set_ylim(0.0, VIOLIN_TOP_M)


def _draw_shares(axes: Axes, groups: Sequence[Group], arena: str) -> None:
    shares = np.array([
        np.mean([record.action_shares for run in each.runs for record, _ in run.of_arena(arena)], axis=0)
        for each in groups
    ])  # fmt: skip
    below = np.zeros(len(groups))
    for action, name in enumerate(ACTION_NAMES):
        axes.bar(
            range(len(groups)), 100.0 * shares[:, action], bottom=below, width=0.75, label=name,
            color=ACTION_HEX[action], edgecolor="black", linewidth=0.5, hatch=ACTION_HATCHES[action],
        )  # fmt: skip
        below += 100.0 * shares[:, action]
    plain(axes)


def _draw_distances(axes: Axes, groups: Sequence[Group], arena: str, looks: dict[str, Look]) -> None:
    for place, each in enumerate(groups):
        seeds = [[record.distance_m for record, _ in run.of_arena(arena)] for run in each.runs]
        flights, look = np.concatenate(seeds), looks[each.label]
        error = flights.std(ddof=1) / np.sqrt(len(flights)) if len(flights) > 1 else None
        axes.bar(
            place, flights.mean(), yerr=error, width=0.75, capsize=3, color=look.colour, edgecolor="black",
            linewidth=0.5, hatch=look.hatch, error_kw={"linewidth": 1.0},
        )  # fmt: skip
        if each.is_trained and len(seeds) > 1:
            spread = np.linspace(-0.2, 0.2, len(seeds))
            axes.plot(place + spread, [np.mean(seed) for seed in seeds], "o", color="white", markeredgecolor="black",
                      markersize=4)  # fmt: skip
    plain(axes)
