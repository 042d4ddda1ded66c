"""Layouts of the viewer: *flight* (default), *ear* (one call, every stage large) and *policy*."""

from __future__ import annotations

import math
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from apex_bat.recording.outlines import arena_extent_m
from apex_bat.recording.series import EAR_NAMES
from apex_bat.simulation.layout import Arena

APPLICATION_ID = "apex_bat"
EYE_FOV_RAD = math.radians(55.0)  # vertical, the viewer's own

_PAST = rr.VisibleTimeRange("step", start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative())
_PAST_S = rr.VisibleTimeRange(
    "sim_time", start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
)
_LASTING = rrb.VisibleTimeRanges([_PAST, _PAST_S])


def flight_blueprint(arena: Arena | None = None) -> rrb.Blueprint:
    """Returns the default layout: chase view and map, both ears, state, values, actions, reward, clearance."""
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Horizontal(_chase(), _map(arena)),
                _actions(),
                rrb.Horizontal(_clearance(), _reward()),
                row_shares=[5, 1.1, 2],
            ),
            rrb.Vertical(
                rrb.Horizontal(*map(_waveform, EAR_NAMES)),
                rrb.Horizontal(*map(_cochleagram, EAR_NAMES)),
                _state(),
                _q(),
                row_shares=[2, 2, 2, 2],
            ),
            column_shares=[5, 4],
        )
    )


def ear_blueprint(arena: Arena | None = None) -> rrb.Blueprint:
    """Returns the layout of one call: for each ear the points by level, waveform, cochleagram and frame, large."""
    del arena
    columns = [
        rrb.Vertical(_points(ear), _waveform(ear), _cochleagram(ear), _frame(ear), row_shares=[3, 2, 2, 2])
        for ear in EAR_NAMES
    ]
    return _blueprint(rrb.Horizontal(*columns))


def policy_blueprint(arena: Arena | None = None) -> rrb.Blueprint:
    """Returns the layout of decisions: state, Q values, value, advantages, actions, reward and what came of them."""
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(_state(), _map(arena), row_shares=[2, 3]),
            rrb.Vertical(_q(), _value(), _advantage(), _actions(), row_shares=[2, 2, 2, 1.2]),
            rrb.Vertical(_reward(), _return(), _clearance(), _progress(), _events()),
            column_shares=[5, 4, 4],
        )
    )


BLUEPRINTS = {"flight": flight_blueprint, "ear": ear_blueprint, "policy": policy_blueprint}


def save_blueprints(folder: Path, arena: Arena | None = None) -> list[Path]:
    """Writes flight.rbl, ear.rbl and policy.rbl into a folder, and returns their paths.

    Name one after the recordings, because the last layout wins: `rerun recordings/*.rrd recordings/ear.rbl`. With an
    arena the map is centred on it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, make in BLUEPRINTS.items():
        paths.append(folder / f"{name}.rbl")
        make(arena).save(APPLICATION_ID, paths[-1])
    return paths


def _blueprint(root: rrb.Container) -> rrb.Blueprint:
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="step", fps=20, play_state="paused"),
    )


def _chase() -> rrb.View:
    eye = rrb.EyeControls3D(kind="orbital", position=(-2.2, 0.0, 1.6), look_target=(1.2, 0.0, 0.0), eye_up=(0, 0, 1))
    return rrb.Spatial3DView(
        name="Behind the bat (points: echo level, violet to yellow)",
        origin="world/bat",
        contents="world/**",
        eye_controls=eye,
        line_grid=False,
        overrides={"world/trajectory": _LASTING, "world/contacts": _LASTING},
    )


def _map(arena: Arena | None) -> rrb.View:
    eye = None
    if arena is not None:
        extent = arena_extent_m(arena)
        x, y = (extent.x_min + extent.x_max) / 2, (extent.y_min + extent.y_max) / 2
        half = max(extent.x_max - extent.x_min, extent.y_max - extent.y_min) / 2 + 0.5
        height = 1.15 * half / math.tan(EYE_FOV_RAD / 2)  # the panel may be narrower than high
        eye = rrb.EyeControls3D(
            kind="orbital", position=(x, y - 0.001, height), look_target=(x, y, 0), eye_up=(0, 1, 0)
        )
    return rrb.Spatial3DView(
        name="Map",
        origin="world",
        contents=["$origin/**", "- world/bat/points"],
        eye_controls=eye,
        line_grid=False,
        overrides={
            "world/trajectory": _LASTING,
            "world/contacts": _LASTING,
            "world/arena/walls": rr.Boxes3D.from_fields(fill_mode="solid"),
            "world/arena/pillars": rr.Cylinders3D.from_fields(fill_mode="solid"),
        },
    )


def _points(ear: str) -> rrb.View:
    mapping = rrb.encodings.VisualizerComponentMapping(
        "Points3D:colors",
        rrb.encodings.ComponentSourceKind.SourceComponent,
        source_component=f"{ear}_colors",
    )
    eye = rrb.EyeControls3D(kind="orbital", position=(-0.9, 0.0, 0.9), look_target=(1.0, 0.0, 0.0), eye_up=(0, 0, 1))
    return rrb.Spatial3DView(
        name=f"Level at the {ear} ear (violet 20 dB to yellow 80 dB SPL, grey unheard)",
        origin="world/bat",
        contents="world/**",
        eye_controls=eye,
        line_grid=False,
        overrides={"world/bat/points": rr.Points3D.from_fields().visualizer(mappings=[mapping])},
    )


def _waveform(ear: str) -> rrb.View:
    return rrb.BarChartView(name=f"Echo, {ear} ear [Pa over ms]", origin=f"echo/{ear}/waveform", plot_legend=_HIDDEN)


def _cochleagram(ear: str) -> rrb.View:
    bounds = rrb.VisualBounds2D(x_range=(-19, 126), y_range=(-1, 49))
    return rrb.Spatial2DView(name=f"Cochleagram, {ear} ear", origin=f"echo/{ear}/cochleagram", visual_bounds=bounds)


def _frame(ear: str) -> rrb.View:
    return rrb.BarChartView(name=f"Echo frame, {ear} ear [over ms]", origin=f"echo/{ear}/frame", plot_legend=_HIDDEN)


def _state() -> rrb.View:
    bounds = rrb.VisualBounds2D(x_range=(-4, 25), y_range=(-0.3, 7.0))
    return rrb.Spatial2DView(name="State, as the network gets it", origin="policy/state", visual_bounds=bounds)


_HIDDEN = rrb.PlotLegend(visible=False)
_LEGEND = rrb.PlotLegend(rrb.Corner2D.LeftTop)


def _plot(name: str, *paths: str) -> rrb.View:
    return rrb.TimeSeriesView(name=name, origin="/", contents=list(paths), plot_legend=_LEGEND)


def _q() -> rrb.View:
    return _plot("Q values", "policy/q", "policy/chosen")


def _value() -> rrb.View:
    return _plot("Value V", "policy/value")


def _advantage() -> rrb.View:
    return _plot("Advantages A", "policy/advantage")


def _reward() -> rrb.View:
    return _plot("Reward by term", "reward/straight", "reward/near")


def _return() -> rrb.View:
    return _plot("Return", "reward/return")


def _clearance() -> rrb.View:
    return _plot("Clearance [m]", "sensor/clearance")


def _progress() -> rrb.View:
    return _plot("Progress and distance [m]", "odometry/progress", "odometry/distance")


def _actions() -> rrb.View:
    return rrb.StateTimelineView(name="Action", origin="policy/action")


def _events() -> rrb.View:
    return rrb.TextLogView(name="Events", origin="events")
