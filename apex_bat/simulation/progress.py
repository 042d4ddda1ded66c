"""Progress along the middle of a corridor loop, which a bat that circles on the spot does not make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.simulation.layout import Arena


class CentreLines(NamedTuple):
    """The closed centre lines of several arenas, padded to the same number of segments."""

    first: NDArray[np.float64]
    """(arenas, segments, 2): where each segment begins."""
    along: NDArray[np.float64]
    """(arenas, segments, 2): its unit vector; 0 in an arena without a centre line."""
    segment_m: NDArray[np.float64]
    """(arenas, segments): its length; 0 for padding."""
    before_m: NDArray[np.float64]
    """(arenas, segments): length of the line before it."""
    length_m: NDArray[np.float64]
    """(arenas,): length of a lap; 0 in an arena without a centre line."""

    def locate(self, points: NDArray[np.float64], arena: NDArray[np.int64]) -> NDArray[np.float64]:
        """Returns how far along its centre line the nearest point to each point lies: float64 (points,), metres.

        Args:
            points: float64 (points, 2).
            arena: int64 (points,), the arena that each point lies in.
        """
        several = len(self.length_m) > 1  # a single arena's line needs no copy for each point
        first, along, segment_m = (
            part[arena] if several else part for part in (self.first, self.along, self.segment_m)
        )
        x, y = points[:, :1] - first[..., 0], points[:, 1:] - first[..., 1]
        along_x, along_y = along[..., 0], along[..., 1]
        ahead_m = np.clip(x * along_x + y * along_y, 0.0, segment_m)
        squared = np.square(x - ahead_m * along_x) + np.square(y - ahead_m * along_y)
        nearest = squared.argmin(axis=1)
        return np.asarray(self.before_m[arena, nearest] + ahead_m[np.arange(len(points)), nearest])

    def advance(
        self, before_m: NDArray[np.float64], after_m: NDArray[np.float64], arena: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Returns the way between two places on the lines, the shorter way round: positive in the line's direction."""
        lap_m = np.maximum(self.length_m[arena], 1e-9)
        return (after_m - before_m + lap_m / 2) % lap_m - lap_m / 2

    def laps(self, progress_m: NDArray[np.float64], arena: NDArray[np.int64]) -> NDArray[np.float64]:
        """Returns progress as a share of the centre lines' lengths; 0 in an arena without one."""
        length_m = self.length_m[arena]
        return np.where(length_m > 0.0, progress_m / np.maximum(length_m, 1e-9), 0.0)


def centre_lines(arenas: Sequence[Arena]) -> CentreLines:
    """Returns the centre lines of arenas; an arena without one gets a line of length 0."""
    lines = [np.array(arena.centre_line or [arena.start], float) for arena in arenas]
    most = max(map(len, lines))
    first = np.stack([np.concatenate([line, np.repeat(line[:1], most - len(line), axis=0)]) for line in lines])
    step = np.roll(first, -1, axis=1) - first
    segment_m = np.hypot(step[..., 0], step[..., 1])
    along = step / np.maximum(segment_m, 1e-9)[..., None]
    before_m = np.cumsum(segment_m, axis=1) - segment_m
    return CentreLines(first, along, segment_m, before_m, segment_m.sum(axis=1))
