"""A drawing of an arena: walls, where bats may start, how wide it is, and the shortest lap."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Episode
from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.models import model_parts
from apex_bat.simulation.motion import fly_arc
from apex_bat.simulation.starts import start_region

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NUM_STARTS = 300
NUM_WIDTHS = 8
LAP_SPACING_M = 0.08
LAP_ROUNDS = 600
"""Sweeps of the string; its longest free part is some 80 points, and needs some five times as many sweeps."""
LAP_PULL = 1.9
"""How far a sweep moves a point, in ways to the middle of its neighbours: near 2 a string becomes taut soonest."""


def draw_arena(arena: Arena, path: Path, *, body: Body | None = None, episode: Episode | None = None) -> None:
    """Writes a PNG of an arena seen from above, with a sample of its safe starts; needs matplotlib.

    Args:
        arena: what to draw.
        path: the file to write.
        body: the robot that starts and laps are for; None: the default.
        episode: says what start is safe; None: the default.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    body, episode = body or Body(), episode or Episode()
    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    axes = figure.add_subplot()
    _draw_starts(axes, arena, body, episode)
    _draw_solids(axes, arena)
    title = f"{arena.name}: safe starts"
    if arena.centre_line:
        widths_m = _draw_widths(axes, arena)
        lap = shortest_lap(arena, body)
        axes.plot(*np.vstack([lap, lap[:1]]).T, color="#d55e00", lw=1.5, label="shortest lap of the robot's middle")
        length_m = float(np.hypot(*(np.roll(lap, -1, axis=0) - lap).T).sum())
        title += f", clear width {widths_m.min():.2f} to {widths_m.max():.2f} m, shortest lap {length_m:.1f} m"
        axes.legend(loc="upper right", fontsize=8)
    axes.set_title(title, fontsize=10)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    FigureCanvasAgg(figure)
    figure.savefig(path, format="png", dpi=100)


def shortest_lap(arena: Arena, body: Body) -> NDArray[np.float64]:
    """Returns the shortest closed path of the robot's middle round the arena, as if it could turn on the spot.

    A taut string: points along the centre line are pulled to the middle of their neighbours and beyond, again and
    again, wherever the robot stays clear of the walls (successive over-relaxation).

    Returns:
        float64 (points, 2), x and y of the corners of the path.

    Raises:
        ValueError: the arena has no centre line.
    """
    if not arena.centre_line:
        raise ValueError(f"arena {arena.name} has no centre line, and so no laps")
    ground = ground_plan([arena])
    lap = _resample(np.array(arena.centre_line), LAP_SPACING_M)
    which = np.zeros(len(lap), np.int64)
    for sweep in range(LAP_ROUNDS):
        part = slice(sweep % 2, None, 2)  # every other point, so that no two neighbours move at once
        middle = (np.roll(lap, 1, axis=0) + np.roll(lap, -1, axis=0))[part] / 2
        pull_m = middle - lap[part]
        for target in (middle, middle + (LAP_PULL - 1.0) * pull_m):  # the nearer one where the farther is not clear
            is_clear = ground.clearance_m(target, which[part]) > body.diameter_m / 2
            lap[part] = np.where(is_clear[:, None], target, lap[part])
    return lap


def lines_across(arena: Arena) -> NDArray[np.float64]:
    """Returns lines across the corridor at the middles of the centre line's legs; their lengths are clear widths.

    Returns:
        float64 (legs, 2, 2): left and right end of each, x and y.
    """
    corners = np.array(arena.centre_line)
    leg = np.roll(corners, -1, axis=0) - corners
    ground, which = ground_plan([arena]), np.zeros(len(corners), np.int64)
    ends = []
    for side_rad in (0.5 * np.pi, -0.5 * np.pi):
        poses = np.c_[corners + leg / 2, np.arctan2(leg[:, 1], leg[:, 0]) + side_rad]
        for _ in range(60):  # sphere tracing: as far as the clearance the way is free, whatever its direction
            clearance_m = np.clip(ground.clearance_m(poses[:, :2], which), 0.0, 5.0)
            poses = fly_arc(poses, np.zeros(len(poses)), clearance_m)
        ends.append(poses[:, :2])
    return np.stack(ends, axis=1)


def _draw_solids(axes: Axes, arena: Arena) -> None:
    from matplotlib.patches import Circle, Polygon, Rectangle

    for wall in arena.walls:
        corner = (wall.x_m - wall.length_m / 2, wall.y_m - wall.thickness_m / 2)
        angle_deg = float(np.degrees(wall.yaw_rad))
        middle = (wall.x_m, wall.y_m)
        axes.add_patch(
            Rectangle(corner, wall.length_m, wall.thickness_m, angle=angle_deg, rotation_point=middle, color="0.25")
        )
    for pillar in arena.pillars:
        axes.add_patch(Circle((pillar.x_m, pillar.y_m), pillar.radius_m, color="0.25"))
    for model in arena.models:
        for part in model_parts(model):
            for triangle in part:
                axes.add_patch(Polygon(triangle[:, :2], color="0.4"))
    axes.autoscale_view()


def _draw_starts(axes: Axes, arena: Arena, body: Body, episode: Episode) -> None:
    region, generator = start_region(arena, body, episode), np.random.default_rng(0)
    axes.scatter(region.cells[:, 0], region.cells[:, 1], s=4, marker="s", color="#dbe9f6", linewidths=0)
    x, y, heading_rad = np.array([region.sample(generator) for _ in range(NUM_STARTS)]).T
    axes.quiver(x, y, np.cos(heading_rad), np.sin(heading_rad), color="#0072b2", scale=45, width=0.0025, pivot="tail")
    axes.plot(*arena.start, marker="*", ms=12, color="black")


def _draw_widths(axes: Axes, arena: Arena) -> NDArray[np.float64]:
    """Draws lines across the corridor with their lengths, and returns the length of each in metres."""
    lines = lines_across(arena)
    widths_m = np.hypot(*(lines[:, 0] - lines[:, 1]).T)
    shown = np.unique(np.linspace(0, len(lines) - 1, min(len(lines), NUM_WIDTHS)).astype(int))
    for line, width_m in zip(lines[shown], widths_m[shown], strict=True):
        axes.plot(*line.T, color="0.35", lw=0.8, marker="|")
        axes.annotate(f"{width_m:.2f} m", tuple(line.mean(axis=0)), fontsize=8, ha="center", backgroundcolor="white")
    return np.asarray(widths_m)


def _resample(corners: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """Returns points at equal distances along a closed line; an even number of them."""
    closed = np.vstack([corners, corners[:1]])
    length_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    count = 2 * max(4, round(length_m[-1] / spacing_m / 2))
    place_m = np.arange(count) * length_m[-1] / count
    return np.stack([np.interp(place_m, length_m, closed[:, axis]) for axis in (0, 1)], axis=1)
