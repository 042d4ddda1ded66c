"""A drawing of one echo, stage by stage (thesis fig. 3.6), for both ears.

`python -m apex_bat.simulation.echo_figure FILE` draws what a bat hears in the middle of a corridor of the arena simple.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import NUM_BINS
from apex_bat.simulation.echo import Echo
from apex_bat.simulation.receiver import LISTENING_S

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EARS = ("left ear", "right ear")
COLOURS = ("#0072b2", "#d55e00")
POSE = (3.811, -0.6, 1.5)
"""x, y, heading in the arena simple of the drawing that the command makes."""


def draw_echo(echo: Echo, path: Path) -> None:
    """Writes a PNG of the stages of one bat's echo; arguments and errors are those of `echo_figure`."""
    echo_figure(echo).savefig(path, format="png", dpi=80)


def echo_figure(echo: Echo) -> Figure:
    """Returns a drawing of the stages of one bat's echo in the rendering `thesis`; needs matplotlib.

    Args:
        echo: what one bat hears; its arrays have no axis of bats.

    Raises:
        ValueError: the echo is that of several bats, or of the rendering `exact`, which has no sound.
    """
    if echo.pressure_pa is None or echo.level_db.ndim != 2:
        raise ValueError("echo_figure takes the echo of one bat, points of shape (points,), in the rendering thesis")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    stages = {
        "impulses (Pa)": np.real(echo.impulse_response),
        "echo (Pa)": echo.pressure_pa,
        "gammatone (Pa)": np.real(echo.gammatone),
        "rectified, ^0.4": echo.compressed,
        "low-passed": echo.envelope,
    }
    figure = Figure(figsize=(9.0, 10.0), layout="constrained")
    rows = figure.subplots(len(stages) + 2, 2, sharex=True, sharey="row")
    for row, (name, samples) in zip(rows, stages.items(), strict=False):
        for ear, axes in enumerate(row):
            axes.plot(
                1e3 * np.arange(samples.shape[-1]) / echo.sample_rate_hz, samples[ear], color=COLOURS[ear], lw=0.6
            )
        row[0].set_ylabel(name, fontsize=8)
    for ear in range(len(EARS)):
        rows[0, ear].set_title(EARS[ear], fontsize=10)
        rows[-2, ear].stairs(echo.frame[ear], np.arange(NUM_BINS + 1), fill=True, color=COLOURS[ear])
        _draw_cochleagram(rows[-1, ear], echo.cochleagram[ear], echo.cochleagram_hz)
        rows[-1, ear].set_xlabel("time since the call (ms)", fontsize=8)
    rows[-2, 0].set_ylabel("frame, 24 means", fontsize=8)
    rows[-1, 0].set_ylabel("cochleagram (kHz)", fontsize=8)
    FigureCanvasAgg(figure)
    return figure


def _draw_cochleagram(axes: Axes, levels: NDArray[np.float32], frequencies_hz: NDArray[np.float64]) -> None:
    times_ms = np.linspace(0.0, 1e3 * LISTENING_S, levels.shape[-1] + 1)
    middles_khz = np.sqrt(frequencies_hz[1:] * frequencies_hz[:-1]) / 1e3
    edges_khz = np.concatenate([frequencies_hz[:1] / 1e3, middles_khz, frequencies_hz[-1:] / 1e3])
    axes.pcolormesh(times_ms, edges_khz, levels, cmap="magma", rasterized=True)


def _echo_in_a_corridor() -> Echo:
    """Returns what a bat hears at `POSE`, from the 1000 rays of the default settings."""
    from apex_bat.simulation.env import EchoFlight
    from apex_bat.simulation.sonar import Sonar

    env = EchoFlight("simple")
    env.reset(options={"pose": POSE})
    sensors, range_m = env.colony.sensors, env.colony.ranges_m[0]
    env.close()
    return Sonar().hear(sensors.azimuth_rad, sensors.elevation_rad, range_m)


if __name__ == "__main__":
    draw_echo(_echo_in_a_corridor(), Path(sys.argv[1]))
