"""The image of the priorities over time: the whole run at any moment, in bounded room."""

from __future__ import annotations

import numpy as np
import pytest

from apex_bat.recording.priorities import MAP_SIZE, PriorityMap
from apex_bat.replay.metrics import PRIORITY_BINS


def one_bin(number: int) -> list[float]:
    """All items in one bin."""
    return [float(k == number) for k in range(PRIORITY_BINS)]


def test_low_priorities_lie_below_high_ones_and_early_ones_to_the_left() -> None:
    drawn = PriorityMap()
    drawn.take(one_bin(0), 0.0)
    drawn.take(one_bin(PRIORITY_BINS - 1), 63.5)
    image = drawn.draw().pixels
    assert image.shape == MAP_SIZE[::-1]
    assert image[-1, :-2].min() == 1.0, "what is known lasts until the next row"
    assert image[0, -1] == 1.0
    np.testing.assert_array_equal(image.sum(axis=0), 2.0)


@pytest.mark.parametrize("num_rows", [1, 63, 64, 65, 127, 128, 129, 1000, 5000])
@pytest.mark.parametrize("is_rarer", [False, True])
def test_any_length_of_run_fills_the_image_in_the_order_of_time(num_rows: int, is_rarer: bool) -> None:
    drawn = PriorityMap()
    times_s = 7.0 + np.arange(num_rows) ** (1.2 if is_rarer else 1.0)
    for time_s in times_s.tolist():
        drawn.take([(time_s - 7.0) / max(times_s[-1] - 7.0, 1.0)] * PRIORITY_BINS, time_s)
    line = drawn.draw().pixels[0].astype(float)
    longest_s = max(1.0, float(np.diff(times_s, prepend=times_s[0]).max()))
    tolerance = 1.0 if num_rows == 1 else 2.0 * longest_s / (times_s[-1] - 7.0) + 3.0 / MAP_SIZE[0]
    np.testing.assert_allclose(line, np.arange(MAP_SIZE[0]) / MAP_SIZE[0], atol=tolerance)
    assert np.all(np.diff(line) >= 0.0)


def test_labels_span_the_time_from_the_first_row_to_the_last() -> None:
    drawn = PriorityMap()
    drawn.take(one_bin(3), 0.0)
    drawn.take(one_bin(3), 240.0)
    assert drawn.draw().time_labels == ["0.0 min", "1.0 min", "2.0 min", "3.0 min", "4.0 min"]
    drawn.take(one_bin(3), 4 * 3600.0)
    assert drawn.draw().time_labels == ["0.0 h", "1.0 h", "2.0 h", "3.0 h", "4.0 h"]
