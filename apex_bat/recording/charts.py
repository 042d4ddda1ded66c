"""How bars and images of a recording are drawn: colours, ranges, and tick labels, which rerun's 2D view lacks."""

from __future__ import annotations

from typing import Literal

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from apex_bat.experience import NUM_BINS
from apex_bat.recording.series import GREY, Rgb

LABEL_COLOUR = (170, 170, 170)
TICKS_MS = (0, 6, 12, 18, 24)
COCHLEA_RANGE = (0.0, 0.3)
"""Cochlea output that the colours span: the mean peak in a corridor is 0.19, and nearer than 0.5 m it saturates."""
Tick = tuple[str, float]
"""A label, and where it stands in pixels from the left or top edge of the image."""


def log_image_style(
    recording: rr.RecordingStream,
    path: str,
    size: tuple[int, int],
    dtype: Literal["F16", "F32"],
    y_ticks: list[Tick],
    *,
    x_ticks: list[Tick] | None = None,
    value_range: tuple[float, float] = COCHLEA_RANGE,
) -> None:
    """Logs once how the images of an entity are drawn, with ticks below and to the left.

    Args:
        recording: where to.
        path: entity path of the image; the labels go to `axes` below it.
        size: width and height in pixels.
        dtype: of the pixels.
        y_ticks: along the left edge.
        x_ticks: along the lower edge; None: the 24 ms of an echo, which the width spans.
        value_range: what the colours span.
    """
    width, height = size
    image = rr.DepthImage.from_fields(
        format=rr.components.ImageFormat(width=width, height=height, channel_datatype=dtype),
        meter=1.0,
        colormap="viridis",
        depth_range=value_range,
        magnification_filter="nearest",
    )
    recording.log(path, image, static=True)
    if x_ticks is None:
        x_ticks = [(f"{ms} ms", ms * width / NUM_BINS) for ms in TICKS_MS]
    below = [(place, 1.02 * height) for _, place in x_ticks]
    beside = [(-0.07 * width, place - 0.06 * height) for _, place in y_ticks]
    labels = [text for text, _ in (*x_ticks, *y_ticks)]
    points = rr.Points2D(below + beside, labels=labels, radii=[0.0], colors=[LABEL_COLOUR], show_labels=True)
    recording.log(f"{path}/axes", points, static=True)


def log_bars_style(
    recording: rr.RecordingStream, path: str, colour: Rgb, places: NDArray[np.float64], width: float
) -> None:
    """Logs once the colour of bars, where they stand (mostly in ms), and how wide each is."""
    abscissa = places.astype(np.float32)
    chart = rr.BarChart(
        np.zeros_like(abscissa), color=colour, abscissa=abscissa, widths=np.full_like(abscissa, width)
    )  # it takes abscissa and widths only together with values
    style = [batch for batch in chart.as_component_batches() if "values" not in str(batch.component_descriptor())]
    recording.log(path, style, static=True)


def log_scale_style(recording: rr.RecordingStream, path: str) -> None:
    """Logs once that two bars without width, one up and one down, stand at 0 ms: they span the y axis of a chart."""
    log_bars_style(recording, path, GREY, np.zeros(2), 0.0)
