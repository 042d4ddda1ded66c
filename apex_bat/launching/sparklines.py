"""Curves made of letters, for the live view in a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

MOST_VALUES = 240
BLOCKS = "▁▂▃▄▅▆▇█"


class History:
    """A figure over the whole run, in at most 240 values: whenever there are more, each two become their mean."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self._period_s = 1.0
        self._due_s = -math.inf

    def take(self, value: float, now_s: float) -> None:
        """Takes the value of now, unless the last one is too young; NaN if there is none."""
        if now_s < self._due_s:
            return
        self._due_s = now_s + self._period_s
        self.values.append(value)
        if len(self.values) > MOST_VALUES:
            self.values = [_mean(self.values[i : i + 2]) for i in range(0, len(self.values), 2)]
            self._period_s *= 2.0


def sparkline(values: Sequence[float], width: int) -> str:
    """Returns a curve of at most `width` characters, from the least to the greatest of the values; NaN is a gap."""
    shown = [_mean(values[i * len(values) // width : (i + 1) * len(values) // width]) for i in range(width)]
    shown = shown if len(values) > width else list(values)
    known = [value for value in shown if not math.isnan(value)]
    if not known:
        return ""
    low, span = min(known), max(known) - min(known)
    steps = len(BLOCKS) - 1
    heights = [0.0 if math.isnan(value) or span == 0.0 else (value - low) / span for value in shown]
    return "".join(
        " " if math.isnan(value) else BLOCKS[round(height * steps)]
        for value, height in zip(shown, heights, strict=True)
    )


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan
