"""What the bat hears in a flight recording: coloured points, waveforms, cochleagrams and echo frames.

The echo frames are those that the bat heard. The stages before them are computed again from the kept ranges, in the
`thesis` rendering, which alone has a waveform; random settings of the sonar then draw other numbers than in flight.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from apex_bat.experience import NUM_BINS, NUM_EARS
from apex_bat.recording.axes import Tick, log_axes
from apex_bat.recording.columns import image_columns, tensor_columns
from apex_bat.recording.flight import Flight
from apex_bat.recording.scene import rgba
from apex_bat.recording.series import EAR_COLOURS, EAR_NAMES, Rgb
from apex_bat.simulation.cochlea import channel_frequencies_hz
from apex_bat.simulation.echo import Echo

LEVEL_RANGE_DB = (20.0, 80.0)  # from the floor of hearing to an echo from 0.3 m
FRAME_RANGE = (0.0, 0.4)  # cochlea output in a corridor: mean peak 0.19; what is nearer than 0.4 m saturates
POINT_RADIUS_M = 0.02
TICKS_MS = (0, 6, 12, 18, 24)
TICKS_KHZ = (25, 40, 60)
# Faint to loud, growing lighter throughout, so that it reads in grey and for the colour-blind.
LEVEL_RAMP = np.array([(60, 40, 130), (135, 45, 130), (205, 70, 90), (245, 140, 45), (252, 225, 130)], float)
SILENT_COLOUR = (75, 75, 80)


class Directions(NamedTuple):
    """Where the rays of the 3D range sensor point."""

    azimuth_rad: NDArray[np.float64]
    """(points,): counter-clockwise from straight ahead."""
    elevation_rad: NDArray[np.float64]
    """(points,): upwards."""

    def unit_vectors(self) -> NDArray[np.float64]:
        """Returns float64 (points, 3): x forward, y left, z up."""
        level = np.cos(self.elevation_rad)
        x, y = level * np.cos(self.azimuth_rad), level * np.sin(self.azimuth_rad)
        return np.stack([x, y, np.sin(self.elevation_rad)], axis=1)


def log_frame_styles(recording: rr.RecordingStream, state_rows: int) -> None:
    """Logs once how echo frames and states of so many rows are drawn: colours, range, axes."""
    for ear, colour in zip(EAR_NAMES, EAR_COLOURS, strict=True):
        _log_bars(recording, f"echo/{ear}/frame", colour, np.arange(0.5, NUM_BINS), 0.9)
    _log_image(recording, "policy/state", NUM_BINS, state_rows, "F32")
    ages = [f"t-{age}" if age else "t" for age in range(state_rows // NUM_EARS - 1, -1, -1)]
    rows = [f"{age} {ear}" for age in ages for ear in EAR_NAMES]
    y_ticks = [(label, row + 0.5) for row, label in enumerate(rows)]
    log_axes(recording, "policy/state", (NUM_BINS, state_rows), _ms_ticks(NUM_BINS), y_ticks)


def log_stage_styles(recording: rr.RecordingStream, echo: Echo) -> None:
    """Logs once how points, waveforms and cochleagrams are drawn: colours, ranges, axes in ms and kHz."""
    recording.log("world/bat/points", rr.Points3D.from_fields(radii=[POINT_RADIUS_M]), static=True)
    num_channels, num_times = echo.cochleagram.shape[-2:]
    frequencies_hz = channel_frequencies_hz(num_channels)
    places = np.interp(TICKS_KHZ, frequencies_hz / 1e3, np.arange(num_channels) + 0.5)
    y_ticks = [(f"{khz} kHz", num_channels - place) for khz, place in zip(TICKS_KHZ, places.tolist(), strict=True)]
    for ear, colour in zip(EAR_NAMES, EAR_COLOURS, strict=True):
        if echo.pressure_pa is not None:
            times_ms = np.arange(echo.pressure_pa.shape[-1]) / echo.sample_rate_hz * 1e3
            _log_bars(recording, f"echo/{ear}/waveform", colour, times_ms, 5.0 * times_ms[1])
        _log_image(recording, f"echo/{ear}/cochleagram", num_times, num_channels, "F16")
        log_axes(recording, f"echo/{ear}/cochleagram", (num_times, num_channels), _ms_ticks(num_times), y_ticks)


def send_points(
    recording: rr.RecordingStream,
    ranges_m: NDArray[np.float32],
    level_db: NDArray[np.float64],
    directions: Directions,
    times: list[rr.TimeColumn],
) -> None:
    """Sends where the rays of some calls hit, in the bat's frame, coloured by the level at the louder ear.

    The colours for each ear alone go along as `left_colors` and `right_colors`; views may be switched to them.

    Args:
        recording: where to.
        ranges_m: float32 (rows, points), inf for a miss.
        level_db: (rows, 2, points), at the left and right ear.
        directions: of the rays.
        times: of the rows.
    """
    is_hit = np.isfinite(ranges_m)
    places = np.where(is_hit, ranges_m, 0.0)[..., None] * directions.unit_vectors()
    counts = is_hit.sum(axis=1)
    levels = np.moveaxis(level_db, 1, 0)
    louder = rr.Points3D.columns(positions=places[is_hit], colors=level_colours(levels.max(axis=0)[is_hit]))
    recording.send_columns("world/bat/points", times, louder.partition(counts))
    columns = [
        rr.ComponentColumn(
            rr.ComponentDescriptor(f"{ear}_colors", component_type="rerun.components.Color"),
            rr.components.ColorBatch(level_colours(level[is_hit])),
        ).partition(counts)
        for ear, level in zip(EAR_NAMES, levels, strict=True)
    ]
    recording.send_columns("world/bat/points", times, columns)


def send_stages(recording: rr.RecordingStream, echo: Echo, times: list[rr.TimeColumn]) -> None:
    """Sends the waveforms in Pa and the cochleagrams of some calls, as float16: within 0.05 % of each value."""
    for number, ear in enumerate(EAR_NAMES):
        if echo.pressure_pa is not None:
            pressure_pa = echo.pressure_pa[:, number].astype(np.float16)
            recording.send_columns(f"echo/{ear}/waveform", times, tensor_columns("BarChart", pressure_pa))
        upside = echo.cochleagram[:, number, ::-1].astype(np.float16)
        recording.send_columns(f"echo/{ear}/cochleagram", times, image_columns(upside))


def send_frames(recording: rr.RecordingStream, flight: Flight, rows: slice, times: list[rr.TimeColumn]) -> None:
    """Sends the echo frames and states of some calls."""
    for number, ear in enumerate(EAR_NAMES):
        recording.send_columns(f"echo/{ear}/frame", times, tensor_columns("BarChart", flight.frame[rows, number]))
    recording.send_columns("policy/state", times, image_columns(flight.state[rows]))


def level_colours(level_db: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Returns uint32 (points,): colours of levels in dB SPL; grey below the floor of hearing."""
    low, high = LEVEL_RANGE_DB
    place = np.clip((level_db - low) / (high - low), 0.0, 1.0) * (len(LEVEL_RAMP) - 1)
    channels = [np.interp(place, np.arange(len(LEVEL_RAMP)), channel) for channel in LEVEL_RAMP.T]
    colours: NDArray[np.uint8] = np.stack(channels, axis=-1).astype(np.uint8)
    colours[level_db < low] = SILENT_COLOUR
    return rgba(colours)


def _log_bars(
    recording: rr.RecordingStream, path: str, colour: Rgb, at_ms: NDArray[np.float64], width_ms: float
) -> None:
    """Logs colour, abscissa in ms and bar width once; a BarChart takes them only together with values."""
    abscissa = at_ms.astype(np.float32)
    chart = rr.BarChart(
        np.zeros_like(abscissa), color=colour, abscissa=abscissa, widths=np.full_like(abscissa, width_ms)
    )
    style = [batch for batch in chart.as_component_batches() if "values" not in str(batch.component_descriptor())]
    recording.log(path, style, static=True)


def _ms_ticks(width: int) -> list[Tick]:
    """Ticks along an image that is as wide as an echo frame is long: 24 values of 1 ms."""
    return [(f"{ms} ms", ms * width / NUM_BINS) for ms in TICKS_MS]


def _log_image(recording: rr.RecordingStream, path: str, width: int, height: int, dtype: Literal["F16", "F32"]) -> None:
    image = rr.DepthImage.from_fields(
        format=rr.components.ImageFormat(width=width, height=height, channel_datatype=dtype),
        meter=1.0,
        colormap="viridis",
        depth_range=FRAME_RANGE,
        magnification_filter="nearest",
    )
    recording.log(path, image, static=True)
