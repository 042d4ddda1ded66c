"""The figures of the thesis's chapter 3, from a moment of a flight: points, directivity, an echo, the bat's states."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import Config
from apex_bat.config.settings import Sonar as SonarSettings
from apex_bat.evaluation.groups import CONDITIONS
from apex_bat.evaluation.print_style import NORMAL, SMALL, new_figure, plain
from apex_bat.evaluation.results import Judged
from apex_bat.experience import NUM_BINS
from apex_bat.simulation.directivity import directivity_db
from apex_bat.simulation.echo_figure import COLOURS, EARS, echo_figure
from apex_bat.simulation.env import EchoFlight
from apex_bat.simulation.sensing import keep_onsets, stack_echoes
from apex_bat.simulation.sonar import Sonar

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

LOUD_MAP, RANGE_MAP = "magma", "viridis"
SHARE_OF_FLIGHT = 0.4
"""Where in a flight the moment is taken: away from its start."""


class Moment(NamedTuple):
    """What a bat met at consecutive calls of a flight, the newest last."""

    config: Config
    where: str
    """In words: which flight, which call."""
    azimuth_rad: NDArray[np.float64]
    """(points,)"""
    elevation_rad: NDArray[np.float64]
    """(points,)"""
    ranges_m: NDArray[np.float64]
    """(calls, points), inf for a miss."""
    frames: NDArray[np.float32]
    """(calls, 2, 24): all that the ears make of it, before any condition."""


def find_moment(run: Judged, arena: str) -> Moment:
    """Returns a moment of the first flight of a run in an arena, heard again with its settings."""
    _, trace = run.of_arena(arena)[0]
    config, num_steps = run.config, len(trace.actions)
    calls = config.sensing.memory_steps
    last = min(max(calls - 1, round(SHARE_OF_FLIGHT * num_steps)), num_steps - 1)
    poses = trace.poses[[max(0, last - back) for back in range(calls - 1, -1, -1)]].astype(np.float64)
    env = EchoFlight(arena, body=config.body, rays=config.rays, sensing=config.sensing, episode=config.episode)
    try:
        ranges_m = []
        for pose in poses:
            env.reset(options={"pose": tuple(pose)})
            ranges_m.append(env.colony.ranges_m[0].astype(np.float64))
        sensors = env.colony.sensors
        azimuth_rad, elevation_rad = sensors.azimuth_rad, sensors.elevation_rad
    finally:
        env.close()
    ear, generator = Sonar(config.sonar), np.random.default_rng(0)
    frames = [ear.hear(azimuth_rad, elevation_rad, reach_m, generator).frame for reach_m in ranges_m]
    where = f"call {last} of the first flight of {run.name} in {arena}"
    return Moment(config, where, azimuth_rad, elevation_rad, np.stack(ranges_m), np.stack(frames))


def point_cloud(moment: Moment) -> Figure:
    """Fig. 3.4: the points of the 3D range sensor around the bat, and their ranges by direction."""
    figure = new_figure(9.0, 3.8)
    reach_m = moment.ranges_m[-1]
    is_hit = np.isfinite(reach_m)
    azimuth, elevation, reach = (part[is_hit] for part in (moment.azimuth_rad, moment.elevation_rad, reach_m))
    level = reach * np.cos(elevation)
    space = figure.add_subplot(1, 2, 1, projection="3d")
    space.scatter(
        level * np.cos(azimuth), level * np.sin(azimuth), reach * np.sin(elevation), c=reach, cmap=RANGE_MAP, s=4
    )
    space.scatter([0.0], [0.0], [0.0], color="black", marker="^", s=40)
    space.set_box_aspect((1.0, 1.0, 0.35))
    space.set(xlabel="ahead (m)", ylabel="left (m)", zlabel="up (m)")
    space.tick_params(labelsize=6)
    space.view_init(elev=28.0, azim=-130.0)
    space.set_title(f"{is_hit.sum()} of {len(reach_m)} rays hit; the bat is the triangle", loc="left", fontsize=NORMAL)
    axes = figure.add_subplot(1, 2, 2)
    points = axes.scatter(np.degrees(azimuth), np.degrees(elevation), c=reach, cmap=RANGE_MAP, marker="s", s=9)
    axes.scatter(
        np.degrees(moment.azimuth_rad[~is_hit]),
        np.degrees(moment.elevation_rad[~is_hit]),
        color="0.85",
        marker="s",
        s=9,
    )
    axes.invert_xaxis()
    plain(axes, "range by direction; grey: a miss", "azimuth (degrees, left is positive)", "elevation (degrees)")
    figure.colorbar(points, ax=axes, label="range (m)")
    return figure


def directivity(sonar: SonarSettings) -> Figure:
    """Fig. 3.5: level that mouth and ears add by direction, and its cut at elevation 0."""
    figure = new_figure(9.0, 3.2)
    azimuth, elevation = np.radians(np.linspace(-90.0, 90.0, 181)), np.radians(np.linspace(0.0, 30.0, 31))
    grid = np.meshgrid(azimuth, elevation)
    level_db = directivity_db(sonar, grid[0].ravel(), grid[1].ravel()).reshape(2, *grid[0].shape)
    left, right, cut = figure.subplots(1, 3)
    steps = np.arange(-36.0, 3.1, 3.0)
    for ear, axes in enumerate((left, right)):
        filled = axes.contourf(
            np.degrees(azimuth), np.degrees(elevation), level_db[ear], levels=steps, cmap=LOUD_MAP, extend="both"
        )
        axes.contour(
            np.degrees(azimuth), np.degrees(elevation), level_db[ear], levels=steps[::2], colors="white", linewidths=0.4
        )
        axes.invert_xaxis()
        plain(axes, EARS[ear], "azimuth (degrees)", "elevation (degrees)" if ear == 0 else "")
        cut.plot(np.degrees(azimuth), level_db[ear, 0], color=COLOURS[ear], linestyle=("-", "--")[ear], label=EARS[ear])
    figure.colorbar(filled, ax=[left, right], label="level (dB)", location="bottom", aspect=50)
    cut.invert_xaxis()
    cut.legend(fontsize=SMALL, frameon=False)
    plain(cut, "elevation 0", "azimuth (degrees)", "level (dB)")
    return figure


def echo_chain(moment: Moment) -> Figure:
    """Fig. 3.6: the newest echo of the moment, stage by stage, in the thesis's rendering."""
    ear = Sonar(moment.config.sonar, rendering="thesis")
    generator = np.random.default_rng(0)
    return echo_figure(ear.hear(moment.azimuth_rad, moment.elevation_rad, moment.ranges_m[-1], generator))


def state(moment: Moment) -> Figure:
    """Fig. 3.7: how the echoes of consecutive calls become the state."""
    calls = len(moment.frames)
    figure = new_figure(9.0, 1.3 + 0.75 * calls)
    grid = figure.add_gridspec(calls, 2)
    stacked = figure.add_subplot(grid[:, 1])
    first: Axes | None = None
    for call, frame in enumerate(moment.frames):
        axes = figure.add_subplot(grid[call, 0], sharex=first, sharey=first)
        first = first or axes
        for ear in range(len(EARS)):
            axes.stairs(frame[ear], np.arange(NUM_BINS + 1), color=COLOURS[ear], linestyle=("-", "--")[ear],
                        linewidth=1.3, label=EARS[ear])  # fmt: skip
        is_last = call == calls - 1
        plain(axes, _when(calls - 1 - call), "delay (ms)" if is_last else "", "output")
        axes.tick_params(labelbottom=is_last)
    assert first is not None  # noqa: S101
    first.legend(fontsize=SMALL, frameon=False)
    image = _draw_state(stacked, stack_echoes(moment.frames[None], "memory")[0], float(moment.frames.max()))
    stacked.set_title("the state, a row for each ear and call", loc="left", fontsize=NORMAL)
    figure.colorbar(image, ax=stacked, label="cochlea output")
    return figure


def states_of_conditions(moment: Moment) -> Figure:
    """Figs. 3.9 to 3.11: what is left of the same state in the conditions memory, no_memory and onset."""
    figure = new_figure(9.0, 1.6 + 0.28 * 2 * len(moment.frames))
    row = figure.subplots(1, len(CONDITIONS))
    loudest = float(moment.frames.max())
    for number, (axes, condition) in enumerate(zip(row, CONDITIONS, strict=True)):
        frames = keep_onsets(moment.frames, moment.config.sensing) if condition == "onset" else moment.frames
        image = _draw_state(axes, stack_echoes(frames[None], condition)[0], loudest, has_names=number == 0)
        axes.set_title(f"3.{9 + number}  {condition}", loc="left", fontsize=NORMAL)
    figure.colorbar(image, ax=row, label="cochlea output")
    return figure


def _draw_state(axes: Axes, echoes: NDArray[np.float32], loudest: float, *, has_names: bool = True) -> AxesImage:
    """Draws rows (2 x calls, 24) of a state; shades go by the root, so that a faint onset is seen."""
    from matplotlib.colors import PowerNorm

    calls = len(echoes) // 2
    image = axes.imshow(
        echoes, aspect="auto", cmap=LOUD_MAP, norm=PowerNorm(0.5, 0.0, loudest or 1.0),
        extent=(0.0, NUM_BINS, len(echoes), 0.0), interpolation="nearest",
    )  # fmt: skip
    names = [f"{_when(calls - 1 - row // 2)}, {('left', 'right')[row % 2]}" for row in range(len(echoes))]
    axes.set_yticks(np.arange(len(echoes)) + 0.5, names if has_names else [""] * len(echoes), fontsize=SMALL)
    for call in range(1, calls):
        axes.axhline(2 * call, color="white", linewidth=0.6)
    axes.set_xlabel("delay (ms)", fontsize=SMALL)
    axes.tick_params(labelsize=SMALL)
    return image


def _when(back: int) -> str:
    return f"t - {back}" if back else "t"
