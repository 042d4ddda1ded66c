"""A flight as a picture for papers and READMEs: the arena from above, and beside it what the bat heard and did.

Drawn by matplotlib without any viewer or display. Colours grow lighter with time and with loudness, so that the picture
reads in grey and for the colour-blind.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from apex_bat.experience import NUM_BINS
from apex_bat.recording.flight import ACTION_NAMES, Flight
from apex_bat.recording.outlines import arena_extent_m, model_triangles_m, wall_corners_m
from apex_bat.recording.series import ACTION_COLOURS, EAR_NAMES, RED
from apex_bat.simulation.layout import Arena

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

DPI = 160
BIN_MS = 1.0  # a value of an echo frame stands for 1 ms of delay
WALL_SHADE = "0.35"
TIME_MAP = "viridis"
TIME_MAP_SHARE = 0.88  # its last, yellow end is too faint on white paper
LOUD_MAP = "magma"


def draw_flight(flight: Flight, arena: Arena, path: Path, *, until_step: int | None = None) -> None:
    """Writes a picture of a flight; the suffix of `path` (.png, .pdf, .svg) says in which format.

    Args:
        flight: what happened.
        arena: where.
        path: the file to write.
        until_step: draw only what happened before this step, as in a film; None: everything.
    """
    from matplotlib.figure import Figure

    num_steps = flight.num_steps if until_step is None else min(max(until_step, 1), flight.num_steps)
    figure = Figure(figsize=(12.0, 5.2), dpi=DPI, layout="constrained")
    grid = figure.add_gridspec(4, 2, width_ratios=[1.0, 1.5], height_ratios=[4, 4, 0.5, 2.2])
    _draw_map(figure, figure.add_subplot(grid[:, 0]), flight, arena, num_steps)
    left = figure.add_subplot(grid[0, 1])
    right, actions, clearance = (figure.add_subplot(grid[row, 1], sharex=left) for row in (1, 2, 3))
    loudest = float(np.quantile(flight.frame, 0.998)) or 1.0
    images = [_draw_strip(axes, flight, ear, num_steps, loudest) for ear, axes in enumerate((left, right))]
    bar = figure.colorbar(images[0], ax=[left, right], pad=0.01, aspect=22)
    bar.set_label("cochlea output")
    _draw_actions(actions, flight, num_steps)
    _draw_clearance(clearance, flight, num_steps)
    for axes in (left, right, actions):
        axes.tick_params(labelbottom=False)
    left.set_title("Echoes heard at each call, and what the bat did", loc="left", fontsize=10)
    figure.savefig(path)


def _draw_map(figure: Figure, axes: Axes, flight: Flight, arena: Arena, num_steps: int) -> None:
    """The arena from above, the trail coloured by time, start, contacts and a scale."""
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.patches import Circle

    axes.add_collection(PolyCollection([wall_corners_m(wall) for wall in arena.walls], facecolors=WALL_SHADE))
    axes.add_collection(PolyCollection(list(model_triangles_m(arena)[..., :2]), facecolors=WALL_SHADE))
    for pillar in arena.pillars:
        axes.add_patch(Circle((pillar.x_m, pillar.y_m), pillar.radius_m, color=WALL_SHADE))
    shades = colormaps[TIME_MAP](np.linspace(0.0, TIME_MAP_SHARE, 256))
    places = flight.poses[: num_steps + 1, :2]
    trail = LineCollection(
        list(np.stack([places[:-1], places[1:]], axis=1)),
        cmap=LinearSegmentedColormap.from_list("time", shades),
        linewidths=1.6,
        capstyle="round",
    )
    trail.set_array(flight.times_s[:num_steps])
    trail.set_clim(0.0, flight.times_s[-1])
    axes.add_collection(trail)
    _draw_marks(axes, flight, num_steps)
    extent = arena_extent_m(arena)
    axes.set_xlim(extent.x_min - 0.2, extent.x_max + 0.2)
    axes.set_ylim(extent.y_min - 0.14 * (extent.y_max - extent.y_min), extent.y_max + 0.1)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(_title(flight), loc="left", fontsize=10)
    _draw_scale(axes, extent.x_min, extent.y_min - 0.07 * (extent.y_max - extent.y_min))
    figure.colorbar(trail, cax=axes.inset_axes((0.45, 0.045, 0.5, 0.02)), orientation="horizontal", label="time [s]")


def _draw_marks(axes: Axes, flight: Flight, num_steps: int) -> None:
    """Start, contacts, and the bat itself where it is last seen."""
    from matplotlib.patches import Circle
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=3, foreground="white")]
    radius_m = flight.facts.body.diameter_m / 2
    x, y, heading = flight.poses[0]
    axes.plot(
        x, y, marker=(3, 0, np.degrees(heading) - 90), markersize=10, color="white", markeredgecolor="black", zorder=5
    )
    axes.annotate("start", (x, y), xytext=(8, 6), textcoords="offset points", fontsize=9, zorder=6, path_effects=halo)
    x, y, heading = flight.poses[num_steps]
    axes.add_patch(Circle((x, y), radius_m, facecolor="white", edgecolor="black", zorder=4))
    axes.plot([x, x + radius_m * np.cos(heading)], [y, y + radius_m * np.sin(heading)], color="black", zorder=4)
    places = flight.poses[1 : num_steps + 1][flight.contact[:num_steps]]
    axes.plot(places[:, 0], places[:, 1], "X", color=_unit(RED), markersize=11, markeredgecolor="white", zorder=6)
    for x, y, _ in places[:1]:
        axes.annotate(
            "contact", (x, y), xytext=(8, -12), textcoords="offset points", fontsize=9, zorder=6, path_effects=halo
        )


def _draw_scale(axes: Axes, x_m: float, y_m: float) -> None:
    axes.plot([x_m, x_m + 1.0], [y_m, y_m], color="black", linewidth=3, solid_capstyle="butt")
    axes.text(x_m + 0.5, y_m - 0.08, "1 m", ha="center", va="top", fontsize=9)


def _draw_strip(axes: Axes, flight: Flight, ear: int, num_steps: int, loudest: float) -> AxesImage:
    """The echo frames of one ear over time, early echoes at the bottom."""
    shown = np.full((flight.num_steps, NUM_BINS), np.nan, np.float32)
    shown[:num_steps] = flight.frame[:num_steps, ear]
    extent = (0.0, float(flight.times_s[-1]), 0.0, NUM_BINS * BIN_MS)
    image = axes.imshow(
        shown.T,
        origin="lower",
        aspect="auto",
        extent=extent,
        cmap=LOUD_MAP,
        vmin=0.0,
        vmax=loudest,
        interpolation="nearest",
    )
    axes.set_ylabel(f"{EAR_NAMES[ear]} ear\ndelay [ms]")
    axes.set_yticks([0, 6, 12, 18, 24])
    return image


def _draw_actions(axes: Axes, flight: Flight, num_steps: int) -> None:
    """The chosen actions as a lane of colours."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    palette = [_unit(colour) for colour in ACTION_COLOURS]
    extent = (0.0, float(flight.times_s[num_steps]), 0.0, 1.0)
    lane = flight.action[None, :num_steps]
    axes.imshow(
        lane, aspect="auto", extent=extent, cmap=ListedColormap(palette), vmin=0, vmax=2, interpolation="nearest"
    )
    axes.set_yticks([])
    axes.set_ylabel("action", rotation=0, ha="right", va="center")
    keys = [Patch(color=colour, label=name) for colour, name in zip(palette, ACTION_NAMES, strict=True)]
    legend = axes.legend(
        handles=keys, loc="upper left", bbox_to_anchor=(1.0, 1.5), frameon=False, fontsize=8, handlelength=1
    )
    legend.set_in_layout(False)


def _draw_clearance(axes: Axes, flight: Flight, num_steps: int) -> None:
    times_s, clearance_m = flight.times_s[1 : num_steps + 1], flight.clearance_m[:num_steps]
    axes.plot(times_s, clearance_m, color="0.2", linewidth=1.0)
    axes.axhline(flight.facts.body.diameter_m / 2, color=_unit(RED), linewidth=1.0, linestyle="--")
    axes.annotate(
        "contact", (0.0, flight.facts.body.diameter_m / 2), xytext=(3, 2), textcoords="offset points", fontsize=8
    )
    axes.set_ylim(0.0, float(flight.clearance_m.max()) * 1.1)
    axes.set_ylabel("clearance\n[m]")
    axes.set_xlabel("time [s]")
    axes.spines[["top", "right"]].set_visible(False)


def _title(flight: Flight) -> str:
    facts = flight.facts
    ends = {"time": "to the time limit", "contact": "until contact", "": "broken off"}
    end = ends.get(flight.end, f"until {flight.end}")
    return f"{facts.condition} in {facts.arena}: {flight.num_steps} steps, {flight.distance_m[-1]:.0f} m, {end}"


def _unit(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    """A colour with channels from 0 to 1, as matplotlib wants it."""
    red, green, blue = (channel / 255 for channel in colour)
    return red, green, blue
