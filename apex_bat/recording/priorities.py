"""The priorities of the replay in a training recording: their histogram now as bars, and over time as an image.

The image spans the whole run so far at every moment: whenever it has no more room, each two of its columns become their
mean, so that its size and that of the recording stay bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from apex_bat.recording.charts import LABEL_COLOUR, Tick, log_bars_style, log_image_style
from apex_bat.recording.columns import image_columns, tensor_columns
from apex_bat.recording.series import BLUE
from apex_bat.replay.metrics import PRIORITY_BINS, PRIORITY_EDGES

MAP_SIZE = (64, 2 * PRIORITY_BINS)
"""Width and height of the image in pixels; the viewer keeps pixels square, and a panel is twice as wide as high."""
SHARE_RANGE = (0.0, 0.25)
"""Share of the items in a bin that the colours span: the fullest bin of a training holds about 0.2 (measured)."""
LABELLED_PRIORITIES = (0.001, 0.01, 0.1, 1.0, 10.0)
FIRST_COLUMN_S = 1.0
"""Time that a column of the image stands for at first: the replay reports once a second."""
TIME_PLACES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Where times are written below the image, in its width."""
HOURS_FROM_S = 7200.0
"""From here times are written in hours, before in minutes."""


class PriorityImage(NamedTuple):
    """The priorities over time, as they are drawn."""

    pixels: NDArray[np.float16]
    """(height, width): shares of the items, the highest priorities on top."""
    time_labels: list[str]
    """What is written below it at `TIME_PLACES`."""


class PriorityMap:
    """The histograms of one replay server over the whole run, in at most as many columns as the image is wide."""

    def __init__(self) -> None:
        width = MAP_SIZE[0]
        self._sums, self._counts = np.zeros((width, PRIORITY_BINS)), np.zeros(width)
        self._column_s = FIRST_COLUMN_S
        self._since_s: float | None = None
        self._until_s = 0.0

    def take(self, shares: Sequence[float], elapsed_s: float) -> None:
        """Takes the share of each bin, the lowest priorities first, and when it was so."""
        if self._since_s is None:
            self._since_s = elapsed_s
        self._until_s = max(self._until_s, elapsed_s)
        while (column := self._column(elapsed_s)) >= len(self._counts):
            half = len(self._counts) // 2
            for values in (self._sums, self._counts):
                values[:half] = values[::2] + values[1::2]
                values[half:] = 0.0
            self._column_s *= 2.0
        self._sums[column] += shares
        self._counts[column] += 1.0

    def draw(self) -> PriorityImage:
        """Returns the image from the first time on the left to now."""
        width, height = MAP_SIZE
        num_columns = self._column(self._until_s) + 1
        known = np.maximum.accumulate(np.where(self._counts > 0.0, np.arange(width), 0))  # a gap shows what was before
        chosen = known[np.arange(width) * num_columns // width]
        means = (self._sums[chosen] / np.maximum(self._counts[chosen], 1.0)[:, None]).T[::-1]
        pixels = np.repeat(means, height // PRIORITY_BINS, axis=0).astype(np.float16)
        return PriorityImage(pixels, self._time_labels())

    def _time_labels(self) -> list[str]:
        since_s = self._since_s or 0.0
        times_s = np.linspace(since_s, self._until_s, len(TIME_PLACES)).tolist()
        unit_s, name = (3600.0, "h") if self._until_s >= HOURS_FROM_S else (60.0, "min")
        return [f"{time_s / unit_s:.1f} {name}" for time_s in times_s]

    def _column(self, elapsed_s: float) -> int:
        return max(0, int((elapsed_s - (self._since_s or 0.0)) / self._column_s))


def log_priorities_style(recording: rr.RecordingStream, path: str) -> None:
    """Logs once how bars and image of a replay server's priorities are drawn.

    Args:
        recording: where to.
        path: entity path of the bars; the image is `over_time` below it.
    """
    low = np.log10(PRIORITY_EDGES)
    log_bars_style(recording, path, BLUE, (low[:-1] + low[1:]) / 2.0, 0.9 * float(low[1] - low[0]))
    height = MAP_SIZE[1]
    below = np.searchsorted(PRIORITY_EDGES, np.array(LABELLED_PRIORITIES) * 0.999)
    y_ticks: list[Tick] = [
        (f"{priority:g}", height * (1.0 - edge / PRIORITY_BINS))
        for priority, edge in zip(LABELLED_PRIORITIES, below.tolist(), strict=True)
    ]
    log_image_style(recording, f"{path}/over_time", MAP_SIZE, "F16", y_ticks, x_ticks=[], value_range=SHARE_RANGE)
    labels = rr.Points2D.from_fields(radii=[0.0], colors=[LABEL_COLOUR], show_labels=True)
    recording.log(f"{path}/over_time/times", labels, static=True)


def send_histograms(
    recording: rr.RecordingStream, path: str, shares: NDArray[np.float64], times: list[rr.TimeColumn]
) -> None:
    """Sends the bars of some rows; `shares` is (rows, bins), the lowest priorities first."""
    recording.send_columns(path, times, tensor_columns("BarChart", shares.astype(np.float32)))


def send_images(
    recording: rr.RecordingStream, path: str, images: Sequence[PriorityImage], times: list[rr.TimeColumn]
) -> None:
    """Sends images of the priorities over time, and the labels below them."""
    recording.send_columns(f"{path}/over_time", times, image_columns(np.stack([image.pixels for image in images])))
    below = [(place * MAP_SIZE[0], 1.04 * MAP_SIZE[1]) for place in TIME_PLACES]
    labels = [label for image in images for label in image.time_labels]
    columns = rr.Points2D.columns(positions=below * len(images), labels=labels)
    recording.send_columns(f"{path}/over_time/times", times, columns.partition([len(below)] * len(images)))
