"""The views that layouts are made of; of one flight, or of one of two that lie below `a` and `b`."""

from __future__ import annotations

import math
from typing import Literal

import rerun as rr
import rerun.blueprint as rrb

from apex_bat.recording.outlines import arena_extent_m
from apex_bat.recording.priorities import MAP_SIZE
from apex_bat.simulation.layout import Arena

EYE_FOV_RAD = math.radians(55.0)  # vertical, the viewer's own
ACTION_LEGEND = "straight green, left blue, right orange"
WINDOW_STEPS = (-80, 40)
"""Steps about the cursor that a close-up shows."""

_PAST = rr.VisibleTimeRange("step", start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative())
_PAST_S = rr.VisibleTimeRange(
    "sim_time", start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
)
_LASTING = rrb.VisibleTimeRanges([_PAST, _PAST_S])
HIDDEN = rrb.PlotLegend(visible=False)
"""No legend: it would cover the curves."""
_CLOSE_UP = rrb.archetypes.TimeAxis(
    view_range=rr.TimeRange(
        start=rr.TimeRangeBoundary.cursor_relative(seq=WINDOW_STEPS[0]),
        end=rr.TimeRangeBoundary.cursor_relative(seq=WINDOW_STEPS[1]),
    )
)
_WHOLE = rrb.archetypes.TimeAxis(
    view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
)


class Views:
    """Makes views of one flight."""

    def __init__(self, arena: Arena | None = None, prefix: str = "", title: str = "") -> None:
        """Takes what is known of the flight.

        Args:
            arena: what the map is centred on; None: the viewer decides.
            prefix: first part of all entity paths.
            title: put before the names of views.
        """
        self._arena, self._prefix, self._title = arena, f"{prefix}/" if prefix else "", f"{title}: " if title else ""

    def chase(self) -> rrb.View:
        """Returns the view from behind the bat."""
        eye = rrb.EyeControls3D(
            kind="orbital", position=(-2.0, 0.0, 1.7), look_target=(1.1, 0.0, 0.1), eye_up=(0, 0, 1)
        )
        legend = "" if self._title else " (echo: violet 20, yellow 80 dB)"  # there is no room for it beside a title
        return rrb.Spatial3DView(
            name=self._name(f"Behind the bat{legend}"),
            origin=self._path("world/bat"),
            contents=self._path("world/**"),
            eye_controls=eye,
            line_grid=False,
            overrides={self._path("world/trajectory"): _LASTING, self._path("world/contacts"): _LASTING},
        )

    def map(self) -> rrb.View:
        """Returns the view from above."""
        return rrb.Spatial3DView(
            name=self._name("Map" if self._title else "Map (vermilion: near a wall)"),
            origin=self._path("world"),
            contents=["$origin/**", f"- {self._path('world/bat/points')}"],
            eye_controls=None if self._arena is None else _eye_above(self._arena, 1.05 if self._title else 1.3),
            line_grid=False,
            overrides={
                self._path("world/trajectory"): _LASTING,
                self._path("world/contacts"): _LASTING,
                self._path("world/arena/walls"): rr.Boxes3D.from_fields(fill_mode="solid"),
                self._path("world/arena/pillars"): rr.Cylinders3D.from_fields(fill_mode="solid"),
            },
        )

    def points(self, ear: str) -> rrb.View:
        """Returns the view of the reflecting points, coloured by the level at one ear."""
        mapping = rrb.encodings.VisualizerComponentMapping(
            "Points3D:colors",
            rrb.encodings.ComponentSourceKind.SourceComponent,
            source_component=f"{ear}_colors",
        )
        eye = rrb.EyeControls3D(
            kind="orbital", position=(-1.1, 0.0, 1.0), look_target=(1.0, 0.0, 0.0), eye_up=(0, 0, 1)
        )
        legend = "" if self._title else " (violet 20, yellow 80 dB)"
        return rrb.Spatial3DView(
            name=self._name(f"Level at the {ear} ear{legend}"),
            origin=self._path("world/bat"),
            contents=self._path("world/**"),
            eye_controls=eye,
            line_grid=False,
            overrides={
                self._path("world/bat/points"): rr.Points3D.from_fields().visualizer(mappings=[mapping]),
                self._path("world/trajectory"): _LASTING,
            },
        )

    def stage(self, stage: str, ear: str, name: str) -> rrb.View:
        """Returns the chart of one stage of one ear, scaled as that of the other ear."""
        return rrb.BarChartView(
            name=self._name(name),
            origin=self._path(f"echo/{ear}/{stage}"),
            contents=["$origin", self._path(f"echo/scale/{stage}")],
            plot_legend=HIDDEN,
        )

    def waveform(self, ear: str) -> rrb.View:
        """Returns the chart of the sound at one ear."""
        return self.stage("waveform", ear, f"Echo, {ear} ear [Pa over ms]")

    def cochleagram(self, ear: str) -> rrb.View:
        """Returns the spectrogram of one ear."""
        bounds = rrb.VisualBounds2D(x_range=(-10, 66), y_range=(-1, 36))
        return rrb.Spatial2DView(
            name=self._name(f"Cochleagram, {ear} ear"),
            origin=self._path(f"echo/{ear}/cochleagram"),
            visual_bounds=bounds,
        )

    def state(self) -> rrb.View:
        """Returns the image of the network's input."""
        bounds = rrb.VisualBounds2D(x_range=(-4, 25), y_range=(-0.3, 7.0))
        return rrb.Spatial2DView(
            name=self._name("State, as the network gets it"), origin=self._path("policy/state"), visual_bounds=bounds
        )

    def q(self, *, close_up: bool = False) -> rrb.View:
        """Returns the curves of the Q values, over the whole flight or around the cursor."""
        return self._curves(f"Q: {ACTION_LEGEND}, chosen pink", "policy/q", "policy/chosen", close_up=close_up)

    def value(self) -> rrb.View:
        """Returns the curve of V around the cursor."""
        return self._curves("Value V", "policy/value", close_up=True)

    def advantage(self) -> rrb.View:
        """Returns the curves of A around the cursor."""
        return self._curves(f"Advantages A: {ACTION_LEGEND}", "policy/advantage", close_up=True)

    def reward(self, *, close_up: bool = False) -> rrb.View:
        """Returns the curves of the reward's terms."""
        return self._curves(
            "Reward: straight green, near vermilion", "reward/straight", "reward/near", close_up=close_up
        )

    def returns(self) -> rrb.View:
        """Returns the curve of the return."""
        return self._curves("Return", "reward/return")

    def clearance(self) -> rrb.View:
        """Returns the curve of the clearance."""
        return self._curves("Clearance [m]", "sensor/clearance")

    def progress(self) -> rrb.View:
        """Returns the curves of progress and distance."""
        return self._curves("Progress green, distance grey [m]", "odometry/progress", "odometry/distance")

    def actions(self, *, close_up: bool = False) -> rrb.View:
        """Returns the lane of the actions."""
        return rrb.StateTimelineView(
            name=self._name(f"Action: {ACTION_LEGEND}"),
            origin=self._path("policy/action"),
            time_view=_CLOSE_UP if close_up else None,
        )

    def events(self) -> rrb.View:
        """Returns the list of events."""
        return events(self._name("Events"), self._path("events"), "step", with_level=True)

    def _curves(self, name: str, *paths: str, close_up: bool = False) -> rrb.View:
        # The legends are in the names: rerun's own would cover the curves.
        return rrb.TimeSeriesView(
            name=self._name(name),
            origin="/",
            contents=[self._path(path) for path in paths],
            plot_legend=HIDDEN,
            axis_x=_CLOSE_UP if close_up else None,
        )

    def _path(self, path: str) -> str:
        return f"{self._prefix}{path}"

    def _name(self, name: str) -> str:
        return f"{self._title}{name}"


def curves(name: str, *paths: str, legend: rrb.Corner2D | None = None, top: float | None = None) -> rrb.View:
    """Returns a view of the curves of some entities over the whole recording.

    Args:
        name: title.
        paths: of the entities.
        legend: the corner that it is in; None: without.
        top: the y axis goes from 0 to this; None: as far as the curves do.
    """
    shown = HIDDEN if legend is None else rrb.PlotLegend(legend)
    # The label of the top would not be drawn on the very edge.
    axis_y = None if top is None else rrb.ScalarAxis(range=(0.0, 1.05 * top))
    return rrb.TimeSeriesView(
        name=name, origin="/", contents=list(paths), plot_legend=shown, axis_x=_WHOLE, axis_y=axis_y
    )


def events(name: str, path: str, timeline: str, *, with_level: bool) -> rrb.View:
    """Returns the list of events; their texts begin with the time, for which the viewer leaves too little room."""
    hidden = rrb.encodings.TimelineColumn(timeline, visible=False)
    columns: list[Literal["loglevel", "body"]] = ["loglevel", "body"] if with_level else ["body"]
    shown = rrb.TextLogColumns(timeline_columns=[hidden], text_log_columns=columns)
    return rrb.TextLogView(name=name, origin=path, columns=shown)


def priorities_over_time(path: str) -> rrb.View:
    """Returns the image of the priorities' histogram over the run so far."""
    width, height = MAP_SIZE
    bounds = rrb.VisualBounds2D(x_range=(-0.13 * width, 1.07 * width), y_range=(-0.03 * height, 1.25 * height))
    name = "Priorities held (yellow: 25 %)"
    return rrb.Spatial2DView(name=name, origin=f"{path}/over_time", visual_bounds=bounds)


def priorities_now(path: str) -> rrb.View:
    """Returns the bars of the priorities' histogram at the cursor."""
    name = "Now, over log10"
    return rrb.BarChartView(name=name, origin=path, contents="$origin", plot_legend=HIDDEN)


def _eye_above(arena: Arena, room: float) -> rrb.EyeControls3D:
    """Where all of an arena is seen from; with more `room` also in a panel that is narrower than high."""
    extent = arena_extent_m(arena)
    x, y = (extent.x_min + extent.x_max) / 2, (extent.y_min + extent.y_max) / 2
    half = max(extent.x_max - extent.x_min, extent.y_max - extent.y_min) / 2 + 0.5
    height = room * half / math.tan(EYE_FOV_RAD / 2)
    return rrb.EyeControls3D(kind="orbital", position=(x, y - 0.001, height), look_target=(x, y, 0), eye_up=(0, 1, 0))
