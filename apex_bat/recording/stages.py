"""The ear of a flight recording, stage by stage (thesis fig. 3.6), and the cochleagram beside it.

The stages are computed again from the kept ranges, in the `thesis` rendering, which alone has a waveform; random
settings of the sonar then draw other numbers than in flight. All numbers are float16: within 0.05 % of each value.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from apex_bat.recording.charts import Tick, log_bars_style, log_image_style, log_scale_style
from apex_bat.recording.columns import image_columns, tensor_columns
from apex_bat.recording.series import EAR_COLOURS, EAR_NAMES
from apex_bat.recording.spectrogram import NUM_CHANNELS, NUM_TIMES, cochleagrams, frequencies_hz
from apex_bat.simulation.echo import Echo

TICKS_KHZ = (20, 30, 40, 50, 60)


class Stage(NamedTuple):
    """One stage of the ear."""

    name: str
    """Entity below `echo/left` and `echo/right`."""
    field: str
    """The array of `Echo` that it holds."""
    every: int
    """Each so-manieth sample is kept."""


STAGES = (
    Stage("waveform", "pressure_pa", 1),
    Stage("gammatone", "gammatone", 1),
    Stage("rectified", "rectified", 1),
    Stage("compressed", "compressed", 1),
    Stage("envelope", "envelope", 10),  # low-passed at 1 kHz: 12.5 kHz is enough
)


def log_stage_styles(recording: rr.RecordingStream, echo: Echo) -> None:
    """Logs once how the stages and the cochleagrams are drawn: colours, ranges, axes in ms and kHz."""
    times_ms = np.arange(echo.gammatone.shape[-1]) / echo.sample_rate_hz * 1e3
    places = np.interp(TICKS_KHZ, frequencies_hz() / 1e3, np.arange(NUM_CHANNELS) + 0.5)
    y_ticks: list[Tick] = [
        (f"{khz} kHz", NUM_CHANNELS - place) for khz, place in zip(TICKS_KHZ, places.tolist(), strict=True)
    ]
    for stage in STAGES:
        log_scale_style(recording, f"echo/scale/{stage.name}")
    for ear, colour in zip(EAR_NAMES, EAR_COLOURS, strict=True):
        for stage in STAGES:
            at_ms = times_ms[:: stage.every]
            log_bars_style(
                recording,
                f"echo/{ear}/{stage.name}",
                colour,
                at_ms,
                5.0 * times_ms[1] if stage.every == 1 else at_ms[1],
            )
        log_image_style(recording, f"echo/{ear}/cochleagram", (NUM_TIMES, NUM_CHANNELS), "F16", y_ticks)


def send_stages(recording: rr.RecordingStream, echo: Echo, times: list[rr.TimeColumn]) -> None:
    """Sends all stages and the cochleagrams of some calls, and the span that both ears' charts share.

    Args:
        recording: where to.
        echo: of the calls, in the rendering `thesis`.
        times: of the calls.
    """
    for stage in STAGES:
        values = getattr(echo, stage.field)[..., :: stage.every].astype(np.float16)
        for number, ear in enumerate(EAR_NAMES):
            recording.send_columns(f"echo/{ear}/{stage.name}", times, tensor_columns("BarChart", values[:, number]))
        recording.send_columns(f"echo/scale/{stage.name}", times, tensor_columns("BarChart", spans(values)))
    if echo.pressure_pa is None:
        raise ValueError("the rendering exact has no waveform; the stages are recorded in the rendering thesis")
    heard = cochleagrams(echo.pressure_pa, echo.sample_rate_hz).astype(np.float16)
    for number, ear in enumerate(EAR_NAMES):
        upside = np.ascontiguousarray(heard[:, number, ::-1])
        recording.send_columns(f"echo/{ear}/cochleagram", times, image_columns(upside))


def spans(values: NDArray[np.float16]) -> NDArray[np.float16]:
    """Returns float16 (rows, 2): the highest and the lowest value of each call, both ears together; 0 between them."""
    return np.stack([values.max(axis=(1, 2), initial=0.0), values.min(axis=(1, 2), initial=0.0)], axis=1)
