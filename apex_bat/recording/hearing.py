"""What the bat hears in a flight recording: points coloured by level, echo frames, and the state of the network.

Frames and states are those that the bat had in flight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from apex_bat.experience import NUM_BINS, NUM_EARS
from apex_bat.recording.charts import log_bars_style, log_image_style, log_scale_style
from apex_bat.recording.columns import image_columns, tensor_columns
from apex_bat.recording.flight import Flight
from apex_bat.recording.scene import rgba
from apex_bat.recording.series import EAR_COLOURS, EAR_NAMES

LEVEL_RANGE_DB = (20.0, 80.0)  # from the floor of hearing to an echo from 0.3 m
POINT_RADIUS_M = 0.02
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
    """Logs once how points, echo frames and states of so many rows are drawn: colours, range, axes."""
    recording.log("world/bat/points", rr.Points3D.from_fields(radii=[POINT_RADIUS_M]), static=True)
    log_scale_style(recording, "echo/scale/frame")
    for ear, colour in zip(EAR_NAMES, EAR_COLOURS, strict=True):
        log_bars_style(recording, f"echo/{ear}/frame", colour, np.arange(0.5, NUM_BINS), 0.9)
    ages = [f"t-{age}" if age else "t" for age in range(state_rows // NUM_EARS - 1, -1, -1)]
    rows = [f"{age} {ear}" for age in ages for ear in EAR_NAMES]
    y_ticks = [(label, row + 0.5) for row, label in enumerate(rows)]
    log_image_style(recording, "policy/state", (NUM_BINS, state_rows), "F32", y_ticks)


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


def send_frames(recording: rr.RecordingStream, flight: Flight, rows: slice, times: list[rr.TimeColumn]) -> None:
    """Sends the echo frames and states of some calls, and the span that both ears' frames share."""
    frames = flight.frame[rows]
    for number, ear in enumerate(EAR_NAMES):
        recording.send_columns(f"echo/{ear}/frame", times, tensor_columns("BarChart", frames[:, number]))
    span = np.stack([frames.max(axis=(1, 2)), np.zeros(len(frames), np.float32)], axis=1)
    recording.send_columns("echo/scale/frame", times, tensor_columns("BarChart", span))
    recording.send_columns("policy/state", times, image_columns(flight.state[rows]))


def level_colours(level_db: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Returns uint32 (points,): colours of levels in dB SPL; grey below the floor of hearing."""
    low, high = LEVEL_RANGE_DB
    place = np.clip((level_db - low) / (high - low), 0.0, 1.0) * (len(LEVEL_RAMP) - 1)
    channels = [np.interp(place, np.arange(len(LEVEL_RAMP)), channel) for channel in LEVEL_RAMP.T]
    colours: NDArray[np.uint8] = np.stack(channels, axis=-1).astype(np.uint8)
    colours[level_db < low] = SILENT_COLOUR
    return rgba(colours)
