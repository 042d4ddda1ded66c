"""The two halves of a flight's picture: the arena from above, and over time what the bat heard and did.

Each is drawn once for the whole flight and can then be set back to any step; a film draws only what moves anew.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import NUM_BINS
from apex_bat.recording.flight import ACTION_NAMES, Flight
from apex_bat.recording.outlines import arena_extent_m, model_triangles_m, wall_corners_m
from apex_bat.recording.series import ACTION_COLOURS, EAR_NAMES, RED, Rgb
from apex_bat.simulation.layout import Arena

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage
    from matplotlib.text import Annotation

BIN_MS = 1.0  # a value of an echo frame stands for 1 ms of delay
WALL_SHADE = "0.35"
TIME_MAP = "viridis"
TIME_MAP_SHARE = 0.88  # its last, yellow end is too faint on white paper
LOUD_MAP = "magma"
_ENDS = {"time": "to the time limit", "contact": "until contact", "": "broken off"}


class MapPanel:
    """The arena from above, the trail coloured by time, start, contacts, the bat, and a scale."""

    def __init__(self, axes: Axes, flight: Flight, arena: Arena) -> None:
        self._flight = flight
        draw_walls(axes, arena)
        self._draw_trail(axes)
        self._draw_marks(axes)
        extent = arena_extent_m(arena)
        below = extent.y_min - 0.14 * (extent.y_max - extent.y_min)
        axes.set(xlim=(extent.x_min - 0.2, extent.x_max + 0.2), ylim=(below, extent.y_max + 0.1), aspect="equal")
        axes.set_axis_off()
        axes.set_title(_title(flight), loc="left", fontsize=10)
        x, y = extent.x_min, (below + extent.y_min) / 2
        axes.plot([x, x + 1.0], [y, y], color="black", linewidth=3, solid_capstyle="butt")
        axes.text(x + 0.5, y - 0.08, "1 m", ha="center", va="top", fontsize=9)

    @property
    def moving(self) -> list[Artist]:
        """What `show` changes, from below to above."""
        return [self._trail, self._body, self._nose, self._contacts, self._contact_label]

    def show(self, num_steps: int) -> None:
        """Shows what had happened after so many steps."""
        flight, radius_m = self._flight, self._flight.facts.body.diameter_m / 2
        self._trail.set_segments(list(self._pieces[:num_steps]))
        self._trail.set_array(flight.times_s[:num_steps])
        x, y, heading = flight.poses[num_steps]
        self._body.set_center((x, y))
        self._nose.set_data([x, x + radius_m * np.cos(heading)], [y, y + radius_m * np.sin(heading)])
        places = flight.poses[1 : num_steps + 1][flight.contact[:num_steps]]
        self._contacts.set_data(places[:, 0], places[:, 1])
        self._contact_label.set_visible(len(places) > 0)

    def _draw_trail(self, axes: Axes) -> None:
        from matplotlib import colormaps
        from matplotlib.collections import LineCollection
        from matplotlib.colors import LinearSegmentedColormap

        flight = self._flight
        self._pieces = np.stack([flight.poses[:-1, :2], flight.poses[1:, :2]], axis=1)
        shades = colormaps[TIME_MAP](np.linspace(0.0, TIME_MAP_SHARE, 256))
        times = LinearSegmentedColormap.from_list("time", shades)
        self._trail = LineCollection([], cmap=times, linewidths=1.6, capstyle="round")
        self._trail.set_clim(0.0, flight.times_s[-1])
        axes.add_collection(self._trail)
        place = axes.inset_axes((0.45, 0.045, 0.5, 0.02))
        axes.figure.colorbar(self._trail, cax=place, orientation="horizontal", label="time [s]")

    def _draw_marks(self, axes: Axes) -> None:
        from matplotlib.patches import Circle

        flight = self._flight
        x, y, heading = flight.poses[0]
        arrow = (3, 0, np.degrees(heading) - 90)
        axes.plot(x, y, marker=arrow, markersize=10, color="white", markeredgecolor="black", zorder=5)
        _label(axes, "start", (x, y), (8, 6))
        self._body = Circle((x, y), flight.facts.body.diameter_m / 2, facecolor="white", edgecolor="black", zorder=4)
        axes.add_patch(self._body)
        (self._nose,) = axes.plot([], [], color="black", zorder=4)
        (self._contacts,) = axes.plot([], [], "X", color=_unit(RED), markersize=11, markeredgecolor="white", zorder=6)
        first = flight.poses[1:][flight.contact][:1, :2]
        place = (float(first[0, 0]), float(first[0, 1])) if len(first) else (x, y)
        self._contact_label = _label(axes, "contact", place, (8, -12))


class TimePanel:
    """Over time: the echo frames of both ears, the actions, and the clearance."""

    def __init__(self, left: Axes, right: Axes, actions: Axes, clearance: Axes, flight: Flight) -> None:
        self._flight = flight
        loudest = float(np.quantile(flight.frame, 0.998)) or 1.0
        self._strips = [_draw_strip(axes, flight, ear, loudest) for ear, axes in enumerate((left, right))]
        bar = left.figure.colorbar(self._strips[0], ax=[left, right], pad=0.01, aspect=22)
        bar.set_label("cochlea output")
        self._lane = _draw_lane(actions, flight)
        self._draw_clearance(clearance)
        for axes in (left, right, actions):
            axes.tick_params(labelbottom=False)
        left.set_title("Echoes heard at each call, and what the bat did", loc="left", fontsize=10)

    @property
    def moving(self) -> list[Artist]:
        """What `show` changes."""
        return [*self._strips, self._lane, self._curve]

    def show(self, num_steps: int) -> None:
        """Shows what had happened after so many steps."""
        flight = self._flight
        for ear, strip in enumerate(self._strips):
            strip.set_data(_until(flight.frame[:, ear], num_steps).T)
        self._lane.set_data(_until(flight.action[:, None], num_steps).T)
        self._curve.set_data(flight.times_s[1 : num_steps + 1], flight.clearance_m[:num_steps])

    def _draw_clearance(self, axes: Axes) -> None:
        flight = self._flight
        radius_m = flight.facts.body.diameter_m / 2
        (self._curve,) = axes.plot([], [], color="0.2", linewidth=1.0)
        axes.axhline(radius_m, color=_unit(RED), linewidth=1.0, linestyle="--")
        axes.annotate("contact", (0.0, radius_m), xytext=(3, 2), textcoords="offset points", fontsize=8)
        axes.set_ylim(0.0, float(flight.clearance_m.max()) * 1.1)
        axes.set_ylabel("clearance\n[m]")
        axes.set_xlabel("time [s]")
        axes.spines[["top", "right"]].set_visible(False)


def _label(axes: Axes, text: str, place: tuple[float, float], offset_points: tuple[int, int]) -> Annotation:
    """Words beside a place, readable above anything."""
    from matplotlib.patheffects import withStroke

    label = axes.annotate(text, place, xytext=offset_points, textcoords="offset points", fontsize=9, zorder=6)
    label.set_path_effects([withStroke(linewidth=3, foreground="white")])
    return label


def draw_walls(axes: Axes, arena: Arena) -> None:
    """Draws walls, pillars and models of an arena, seen from above."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Circle

    axes.add_collection(PolyCollection([wall_corners_m(wall) for wall in arena.walls], facecolors=WALL_SHADE))
    axes.add_collection(PolyCollection(list(model_triangles_m(arena)[..., :2]), facecolors=WALL_SHADE))
    for pillar in arena.pillars:
        axes.add_patch(Circle((pillar.x_m, pillar.y_m), pillar.radius_m, color=WALL_SHADE))


def _draw_strip(axes: Axes, flight: Flight, ear: int, loudest: float) -> AxesImage:
    """The echo frames of one ear over time, early echoes at the bottom."""
    image = axes.imshow(
        flight.frame[:, ear].T,
        origin="lower",
        aspect="auto",
        extent=(0.0, float(flight.times_s[-1]), 0.0, NUM_BINS * BIN_MS),
        cmap=LOUD_MAP,
        vmin=0.0,
        vmax=loudest,
        interpolation="nearest",
    )
    axes.set_ylabel(f"{EAR_NAMES[ear]} ear\ndelay [ms]")
    axes.set_yticks([0, 6, 12, 18, 24])
    return image


def _draw_lane(axes: Axes, flight: Flight) -> AxesImage:
    """The chosen actions as a lane of colours."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    palette = [_unit(colour) for colour in ACTION_COLOURS]
    lane = axes.imshow(
        flight.action[None],
        aspect="auto",
        extent=(0.0, float(flight.times_s[-1]), 0.0, 1.0),
        cmap=ListedColormap(palette),
        vmin=0,
        vmax=len(palette) - 1,
        interpolation="nearest",
    )
    axes.set_yticks([])
    axes.set_ylabel("action", rotation=0, ha="right", va="center")
    keys = [Patch(color=colour, label=name) for colour, name in zip(palette, ACTION_NAMES, strict=True)]
    legend = axes.legend(
        handles=keys, loc="upper left", bbox_to_anchor=(1.0, 1.5), frameon=False, fontsize=8, handlelength=1
    )
    legend.set_in_layout(False)
    return lane


def _until(rows: NDArray[np.generic], num_steps: int) -> NDArray[np.float32]:
    """The rows (steps, ...) up to a step; those after it are blank."""
    shown = np.full(rows.shape, np.nan, np.float32)
    shown[:num_steps] = rows[:num_steps]
    return shown


def _title(flight: Flight) -> str:
    facts, end = flight.facts, _ENDS.get(flight.end, f"until {flight.end}")
    return f"{facts.condition} in {facts.arena}: {flight.num_steps} steps, {flight.distance_m[-1]:.0f} m, {end}"


def _unit(colour: Rgb) -> tuple[float, float, float]:
    """A colour with channels from 0 to 1, as matplotlib wants it."""
    red, green, blue = (channel / 255 for channel in colour)
    return red, green, blue
