"""The world: PyBullet bodies of arenas and bats, contact between them, and pictures.

Bats have no contact with each other. Several arenas stand side by side in one world, so far apart that no ray reaches
from one to the next; all poses given and returned are in the coordinates of the arena that a bat is in.
"""

from __future__ import annotations

import math
import os
import sys
import warnings
import weakref
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Body
from apex_bat.simulation.bodies import build_arena, build_bat
from apex_bat.simulation.bullet import pybullet
from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.motion import fly_arc

NEAR_M = 0.002
"""Bats nearer than this to a footprint are checked for contact by PyBullet, whose distances differ by 0.1 mm."""
MAX_PUSHES = 4
"""Pushes out of walls before a bat is put back to where it came from; two walls of a corner need two or three."""
TOUCH_M = 1e-4
"""What is left of a contact after a push; Bullet's distances are that exact."""


class World:
    """PyBullet client with the bodies of some arenas and of `num_bats` robots. Close it, or use it in a `with`."""

    def __init__(
        self,
        arenas: Sequence[Arena],
        body: Body,
        num_bats: int,
        gap_m: float = 20.0,
        gui: bool = False,
    ) -> None:
        """Makes the bodies.

        Args:
            arenas: the arenas, each checked to have a safe start.
            body: the robot.
            num_bats: how many robots there are.
            gap_m: distance between arenas; no ray is longer.
            gui: whether PyBullet opens its window; else it computes only.
        """
        self.client = _connect(gui)
        self._closer = weakref.finalize(self, pybullet.disconnect, self.client)
        self._body = body
        self._radius_m = body.diameter_m / 2
        self.ground = ground_plan(arenas)
        """The footprints of the fixed bodies, in the coordinates of each arena."""
        self._extents_m = np.array(
            [(np.min(arena.corners(), axis=0), np.max(arena.corners(), axis=0)) for arena in arenas]
        )
        self.offsets_m = _tile(self._extents_m, gap_m)
        """float64 (arenas, 2), where the origin of each arena lies in the world."""
        built = [build_arena(self.client, arena, offset) for arena, offset in zip(arenas, self.offsets_m, strict=True)]
        self.solids = self._order_solids(arenas, [solids for solids, _ in built])
        """int64 (arenas, footprints), PyBullet's number of the body behind each footprint; -1 for padding."""
        self.triangles = np.concatenate([surface for _, surface in built]).astype(np.float32)
        """float32 (triangles, 3, 3), the surfaces of all fixed bodies, in the world's coordinates."""
        tops_m = {arena.top_m for arena in arenas}
        self.top_m = tops_m.pop() if len(tops_m) == 1 else None
        """Height of all fixed bodies, where all are upright and of one height; None where they are not."""
        self.bats = [build_bat(self.client, body) for _ in range(num_bats)]
        """PyBullet's numbers of the robots; their bodies stand where `show_bats` put them."""
        self._places = np.zeros((num_bats, 3))
        self._is_watched = gui

    def __enter__(self) -> World:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the client; further calls do nothing."""
        self._closer()

    def fly(
        self,
        rows: NDArray[np.int64],
        poses: NDArray[np.float64],
        arena: NDArray[np.int64],
        turn_rad: NDArray[np.float64],
        length_m: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Flies bats along arcs and stops them at walls, along which they slide.

        The arc is cut so that no part is longer than the robot's radius: a robot that starts outside a wall then ends
        with its middle still outside, and is pushed out on the side it came from.

        Args:
            rows: int64 (n,), which bats.
            poses: float64 (n, 3), where they are.
            arena: int64 (n,), the arena each is in.
            turn_rad: float64 (n,), by how much each turns.
            length_m: float64 (n,), the length of each path.

        Returns:
            float64 (n, 3), where they are afterwards, and bool (n,), which touched something.
        """
        touched = np.zeros(len(rows), bool)
        parts = max(1, math.ceil(float(length_m.max(initial=0.0)) / self._radius_m))
        for _ in range(parts):
            ahead = fly_arc(poses, turn_rad / parts, length_m / parts)
            distance_m = self.ground.distance_m(ahead[:, :2], arena)
            for k in np.flatnonzero((distance_m < self._radius_m + NEAR_M).any(axis=1)):
                near = np.flatnonzero(distance_m[k] < self._radius_m + NEAR_M)
                touched[k] |= self._push_out(int(rows[k]), int(arena[k]), near, poses[k], ahead[k])
            poses = ahead
        self.place(rows, poses, arena)
        return poses, touched

    def place(self, rows: NDArray[np.int64], poses: NDArray[np.float64], arena: NDArray[np.int64]) -> None:
        """Says where bats are. Their bodies follow when somebody looks: moving one takes PyBullet 10 us."""
        self._places[rows] = poses
        self._places[rows, :2] += self.offsets_m[arena]
        if self._is_watched:
            self.show_bats()

    def show_bats(self) -> None:
        """Moves the bodies of all bats to where the bats are."""
        for bat, place in enumerate(self._places.tolist()):
            self._set_pose(bat, *place)

    def picture(self, arena: int = 0, width: int = 640, height: int = 480) -> NDArray[np.uint8]:
        """Returns a camera picture of an arena, seen from above and from the south: uint8 (height, width, 3)."""
        low, high = self._extents_m[arena]
        middle, size_m = (low + high) / 2 + self.offsets_m[arena], float((high - low).max())
        view = pybullet.computeViewMatrixFromYawPitchRoll([*middle, 0.0], 1.05 * size_m, 0.0, -65.0, 0.0, 2)
        lens = pybullet.computeProjectionMatrixFOV(60.0, width / height, 0.1, 4.0 * size_m)
        self.show_bats()
        pixels = pybullet.getCameraImage(
            width, height, view, lens, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=self.client
        )[2]
        return np.asarray(pixels, np.uint8).reshape(height, width, 4)[:, :, :3].copy()

    def _push_out(
        self, bat: int, arena: int, near: NDArray[np.int64], before: NDArray[np.float64], pose: NDArray[np.float64]
    ) -> bool:
        """Moves a pose, in place, out of the solids it has entered; returns whether there were any."""
        solids = dict.fromkeys(self.solids[arena, near].tolist())  # each once: a model has several footprints
        offset_x_m, offset_y_m = self.offsets_m[arena].tolist()
        x_m, y_m, heading_rad = pose.tolist()
        for attempt in range(MAX_PUSHES):
            self._set_pose(bat, x_m + offset_x_m, y_m + offset_y_m, heading_rad)
            depth_m, normal_x, normal_y = self._deepest_contact(bat, solids)
            if depth_m <= (TOUCH_M if attempt else 0.0):
                pose[:2] = x_m, y_m
                return attempt > 0
            level = math.hypot(normal_x, normal_y)
            if level < 0.5:  # a low body would lift the robot: it cannot drive up
                break
            x_m += depth_m * normal_x / level
            y_m += depth_m * normal_y / level
        pose[:2] = before[:2]
        return True

    def _deepest_contact(self, bat: int, solids: Iterable[int]) -> tuple[float, float, float]:
        """Returns how far a bat has entered solids, in metres, and x, y of the unit vector out of the deepest one."""
        contacts = [
            contact
            for solid in solids
            for contact in pybullet.getClosestPoints(self.bats[bat], solid, 0.0, physicsClientId=self.client)
        ]
        if not contacts:
            return 0.0, 0.0, 0.0
        deepest = min(contacts, key=lambda contact: float(contact[8]))
        return -deepest[8], deepest[7][0], deepest[7][1]

    def _order_solids(self, arenas: Sequence[Arena], solids: Sequence[Sequence[int]]) -> NDArray[np.int64]:
        """Returns the number of the solid behind each footprint of the ground plan: int64 (arenas, footprints)."""
        most_boxes = self.ground.boxes.shape[1]
        ordered = np.full((len(arenas), most_boxes + self.ground.circles.shape[1]), -1)
        for row, arena, numbers in zip(ordered, arenas, solids, strict=True):
            boxes = len(numbers) - len(arena.pillars)
            row[:boxes] = numbers[:boxes]
            row[most_boxes : most_boxes + len(arena.pillars)] = numbers[boxes:]
        return ordered

    def _set_pose(self, bat: int, x_m: float, y_m: float, heading_rad: float) -> None:
        turn = (0.0, 0.0, math.sin(heading_rad / 2), math.cos(heading_rad / 2))
        pybullet.resetBasePositionAndOrientation(
            self.bats[bat], (x_m, y_m, self._body.sensor_height_m / 2), turn, physicsClientId=self.client
        )


def _connect(gui: bool) -> int:
    """Returns the number of a new PyBullet client."""
    if gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        # PyBullet would end the whole process; Gymnasium's check_env wants "human" to work on a server too.
        warnings.warn("DISPLAY is not set, so PyBullet shows no window", RuntimeWarning, stacklevel=3)
        gui = False
    if not gui:
        return int(pybullet.connect(pybullet.DIRECT))
    client = int(pybullet.connect(pybullet.GUI))
    if client < 0:
        raise RuntimeError("PyBullet could not open its window; only one may be open at a time")
    return client


def _tile(extents_m: NDArray[np.float64], gap_m: float) -> NDArray[np.float64]:
    """Returns where arenas lie in a square grid, `gap_m` apart; a single one lies at the origin.

    Args:
        extents_m: float64 (arenas, 2, 2), the lower and upper corners of each.
        gap_m: least distance between two of them.
    """
    columns = math.ceil(math.sqrt(len(extents_m)))
    pitch_m = 2.0 * float(np.abs(extents_m).max()) + gap_m
    row, column = np.divmod(np.arange(len(extents_m)), columns)
    return pitch_m * np.stack([column - (columns - 1) // 2, row - (columns - 1) // 2], axis=1)
