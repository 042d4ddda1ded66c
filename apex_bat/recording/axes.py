"""Tick labels beside images, which rerun's 2D view does not draw by itself."""

from __future__ import annotations

import rerun as rr

LABEL_COLOUR = (170, 170, 170)
Tick = tuple[str, float]
"""A label, and where it stands in pixels from the left or top edge of the image."""


def log_axes(
    recording: rr.RecordingStream, path: str, size: tuple[int, int], x_ticks: list[Tick], y_ticks: list[Tick]
) -> None:
    """Logs ticks and labels below and to the left of an image.

    Args:
        recording: where to.
        path: entity path of the image; the axes go to `axes` below it.
        size: width and height of the image in pixels.
        x_ticks: along the lower edge.
        y_ticks: along the left edge.
    """
    width, height = size
    below = [(place, height + 0.02 * height) for _, place in x_ticks]
    beside = [(-0.07 * width, place - 0.06 * height) for _, place in y_ticks]
    labels = [text for text, _ in (*x_ticks, *y_ticks)]
    points = rr.Points2D(below + beside, labels=labels, radii=[0.0], colors=[LABEL_COLOUR], show_labels=True)
    recording.log(f"{path}/axes", points, static=True)
