"""Safe starts: poses from which a bat can fly on, spread evenly over the drivable region.

At 3 m/s and 18 degrees a step, a robot that faces a wall from half a metre cannot escape whatever it does. So a start
must be clear of the walls, and a way out must exist: straight flight or a full turn to the left or right stays clear,
and still does after the first `episode.listening_steps` straight ones. With two of them the memory of three echoes is
full before anything must be decided. Without them many a start hangs on what a single echo tells, too little to choose
the side by (figures in docs/simulation.md).
"""

from __future__ import annotations

import math
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Episode
from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena, ArenaError
from apex_bat.simulation.motion import TURN_SIGN, fly_arc, step_length_m, step_turn_rad

CELL_M = 0.05
"""Cells of the grid on which the drivable region is found."""
GRID_ERROR_M = 0.002
"""What interpolating in the grid may add to a clearance: cell^2 / (8 x clearance) at the outer corner of a wall."""
WAY_OUT_M = 1.5
"""Length of the path that must stay clear: half a turn at the thesis's radius, 0.477 m."""
NUM_STARTS = 4096
"""Safe poses that are drawn once for each arena; an episode begins at one of them, which costs 2 us instead of 300."""
CANDIDATES = 256
"""Poses drawn at a time; about half of them are safe in the thesis's arenas."""
MAX_MISSES = 32
"""After this many draws in a row without a safe pose the arena is said to have none."""


@cache
def start_region(arena: Arena, body: Body, episode: Episode) -> StartRegion:
    """Returns where bats may start in an arena; computed once for equal arguments."""
    return StartRegion(arena, body, episode)


class StartRegion:
    """The part of the drivable region, connected to the arena's start point, where a bat may begin."""

    def __init__(self, arena: Arena, body: Body, episode: Episode) -> None:
        """Raises ArenaError where there is no safe start."""
        self._arena = arena
        self._ground = ground_plan([arena])
        self._radius_m = body.diameter_m / 2
        self._safe_m = max(episode.safe_start_m, self._radius_m)
        self._ways_out = _ways_out(body, episode.listening_steps)
        self._listening_steps = episode.listening_steps
        corners = np.array(arena.corners())
        self._low = corners.min(axis=0)
        columns, rows = np.ceil((corners.max(axis=0) - self._low) / CELL_M).astype(int) + 1
        ys = self._low[1] + CELL_M * np.arange(rows)
        lines = [np.stack([np.full(rows, self._low[0] + CELL_M * k), ys], axis=1) for k in range(columns)]
        self._grid_m = np.array([self._clearance_m(line) for line in lines])
        self.cells = self._find_cells()
        """float64 (cells, 2), the middles of cells that are connected to the start and may hold a safe pose."""
        self._draw_poses(1)

    @cached_property
    def poses(self) -> NDArray[np.float64]:
        """float64 (`NUM_STARTS`, 3), safe poses x, y, heading, spread evenly over those there are."""
        return self._draw_poses(NUM_STARTS)

    def sample(self, generator: np.random.Generator) -> NDArray[np.float64]:
        """Returns one of the safe poses, float64 (3,): x, y, heading."""
        return np.asarray(self.poses[generator.integers(NUM_STARTS)])

    def is_safe(self, poses: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Returns which poses (n, 3) are clear of the walls and have a way out."""
        cosine, sine = np.cos(poses[:, 2])[:, None, None], np.sin(poses[:, 2])[:, None, None]
        ahead, aside = self._ways_out[..., 0], self._ways_out[..., 1]
        x = poses[:, 0, None, None] + cosine * ahead - sine * aside
        y = poses[:, 1, None, None] + sine * ahead + cosine * aside
        clearance_m = self._interpolate_m(x, y) - GRID_ERROR_M
        has_way_out = (clearance_m.min(axis=2) > self._radius_m).any(axis=1)
        return np.asarray((clearance_m[:, 0, 0] > self._safe_m) & has_way_out)

    def _draw_poses(self, count: int) -> NDArray[np.float64]:
        """Returns safe poses (count, 3), always the same ones; x, y and heading are uniform before the check."""
        generator, misses = np.random.default_rng(0), 0
        safe = np.empty((0, 3))
        while len(safe) < count:
            cells = self.cells[generator.integers(len(self.cells), size=CANDIDATES)]
            points = cells + CELL_M * (generator.random((CANDIDATES, 2)) - 0.5)
            poses = np.concatenate([points, generator.uniform(-np.pi, np.pi, (CANDIDATES, 1))], axis=1)
            is_safe = self.is_safe(poses)
            safe = np.concatenate([safe, poses[is_safe]])
            misses = 0 if is_safe.any() else misses + 1
            if misses == MAX_MISSES:
                straight = f" after {self._listening_steps} straight steps (episode.listening_steps)"
                raise self._no_start(
                    f"no way out was found{straight * bool(self._listening_steps)} from any pose that was tried"
                )
        return safe[:count]

    def _find_cells(self) -> NDArray[np.float64]:
        is_free = self._grid_m > self._radius_m
        column, row = (np.rint((np.array(self._arena.start) - self._low) / CELL_M)).astype(int)
        if not is_free[column, row]:
            raise self._no_start(
                f"its start {self._arena.start} lies in a wall or nearer than the robot's radius to one"
            )
        maybe = connected(is_free, column, row) & (self._grid_m > self._safe_m - CELL_M * math.sqrt(0.5))
        if not maybe.any():
            raise self._no_start(f"nowhere is the clearance more than {self._safe_m} m")
        return np.asarray(self._low + CELL_M * np.argwhere(maybe))

    def _clearance_m(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._ground.clearance_m(points, np.zeros(len(points), np.int64))

    def _interpolate_m(self, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns clearances from the grid, bilinearly: several times cheaper than distances to all walls."""
        columns, rows = self._grid_m.shape
        u = np.clip((x_m - self._low[0]) / CELL_M, 0.0, columns - 1.001)
        v = np.clip((y_m - self._low[1]) / CELL_M, 0.0, rows - 1.001)
        column, row = u.astype(np.int64), v.astype(np.int64)
        u, v = u - column, v - row
        first = column * rows + row
        grid_m = self._grid_m.ravel()
        near = (1.0 - v) * grid_m[first] + v * grid_m[first + 1]
        far = (1.0 - v) * grid_m[first + rows] + v * grid_m[first + rows + 1]
        return np.asarray((1.0 - u) * near + u * far)

    def _no_start(self, why: str) -> ArenaError:
        return ArenaError(f"arena {self._arena.name}: its walls leave no safe start: {why}")


def _ways_out(body: Body, listening_steps: int) -> NDArray[np.float64]:
    """Returns points (3 actions, points, 2), metres ahead and to the left, on the actions' paths from the start.

    The paths begin with `listening_steps` straight steps, and then hold one action for `WAY_OUT_M`.
    """
    half_m, half_rad = step_length_m(body) / 2, step_turn_rad(body) / 2
    turns = [np.zeros(3)] * (2 * listening_steps) + [TURN_SIGN * half_rad] * math.ceil(WAY_OUT_M / half_m)
    poses = np.zeros((3, 3))
    paths = [poses[:, :2]]
    for turn_rad in turns:
        poses = fly_arc(poses, turn_rad, np.full(3, half_m))
        paths.append(poses[:, :2])
    return np.asarray(np.stack(paths, axis=1))


def connected(is_free: NDArray[np.bool_], column: int, row: int) -> NDArray[np.bool_]:
    """Returns the cells (columns, rows) that free ones, side by side, connect with a free one.

    Whole columns and rows of free cells are taken in turn, so that there are as many turns as the way has corners.
    """
    reached = np.zeros_like(is_free)
    reached[column, row] = True
    num_reached = 0
    while (count := int(np.count_nonzero(reached))) > num_reached:
        num_reached = count
        reached = _along_rows(_along_rows(reached, is_free).T, is_free.T).T
    return reached


def _along_rows(reached: NDArray[np.bool_], is_free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns the free cells that lie in one unbroken stretch of the last axis with one that is reached."""
    is_first = is_free.copy()
    is_first[:, 1:] &= ~is_free[:, :-1]
    stretch = np.cumsum(is_first).reshape(is_free.shape)
    is_reached = np.zeros(stretch[-1, -1] + 1, np.bool_)
    is_reached[stretch[reached]] = True
    return is_reached[stretch] & is_free
