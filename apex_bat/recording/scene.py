"""The visible world of a flight recording: arena, bat, trail and marks of contact. Entities below `world`."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from apex_bat.config.settings import Body
from apex_bat.recording.flight import Flight
from apex_bat.recording.outlines import arena_extent_m, model_triangles_m
from apex_bat.recording.series import BLUE, GREEN, GREY, ORANGE, RED, Rgb
from apex_bat.simulation.layout import Arena

FLOOR_MARGIN_M = 0.5
TRAIL_HEIGHT_M = 0.02  # just above the floor, so that the bat's body never hides it from above
WALL_COLOUR = (150, 155, 165)
FLOOR_COLOUR = (40, 42, 48)


def log_arena(recording: rr.RecordingStream, arena: Arena) -> None:
    """Logs floor, walls, pillars and models, which never change."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    extent = arena_extent_m(arena)
    low = (extent.x_min - FLOOR_MARGIN_M, extent.y_min - FLOOR_MARGIN_M, -0.02)
    size = (extent.x_max + FLOOR_MARGIN_M - low[0], extent.y_max + FLOOR_MARGIN_M - low[1], 0.01)
    floor = rr.Boxes3D(mins=[low], sizes=[size], colors=[FLOOR_COLOUR], fill_mode="solid")
    recording.log("world/arena/floor", floor, static=True)
    if arena.walls:
        walls = rr.Boxes3D(
            centers=[(wall.x_m, wall.y_m, wall.height_m / 2) for wall in arena.walls],
            sizes=[(wall.length_m, wall.thickness_m, wall.height_m) for wall in arena.walls],
            quaternions=yaw_quaternions(np.array([wall.yaw_rad for wall in arena.walls])),
            colors=[WALL_COLOUR],
            fill_mode="transparentfillmajorwireframe",
        )
        recording.log("world/arena/walls", walls, static=True)
    if arena.pillars:
        pillars = rr.Cylinders3D(
            centers=[(pillar.x_m, pillar.y_m, pillar.height_m / 2) for pillar in arena.pillars],
            radii=[pillar.radius_m for pillar in arena.pillars],
            lengths=[pillar.height_m for pillar in arena.pillars],
            colors=[WALL_COLOUR],
            fill_mode="transparentfillmajorwireframe",
        )
        recording.log("world/arena/pillars", pillars, static=True)
    if arena.models:
        corners = model_triangles_m(arena).reshape(-1, 3)
        models = rr.Mesh3D(vertex_positions=corners, albedo_factor=WALL_COLOUR)
        recording.log("world/arena/models", models, static=True)


def log_bat(recording: rr.RecordingStream, body: Body) -> None:
    """Logs the bat in its own frame: x forward, y left, z up, the origin at mouth and ears."""
    radius_m, height_m = body.diameter_m / 2, body.sensor_height_m
    trunk = rr.Cylinders3D(
        centers=[(0, 0, -height_m / 2)],
        radii=[radius_m],
        lengths=[height_m],
        colors=[GREY],
        fill_mode="transparentfillmajorwireframe",
    )
    recording.log("world/bat/body", trunk, static=True)
    heading = rr.Arrows3D(vectors=[(3 * radius_m, 0, 0)], radii=[radius_m / 9], colors=[GREEN])
    recording.log("world/bat/heading", heading, static=True)
    ears = rr.Ellipsoids3D(
        centers=[(0, radius_m / 2, radius_m / 3), (0, -radius_m / 2, radius_m / 3)],
        half_sizes=[(radius_m / 5, radius_m / 5, radius_m / 2)],
        colors=[BLUE, ORANGE],
        fill_mode="solid",
    )
    recording.log("world/bat/ears", ears, static=True)


def send_motion(recording: rr.RecordingStream, flight: Flight, rows: slice, times: list[rr.TimeColumn]) -> None:
    """Sends the pose of the bat at some rows of `flight.poses`, whose times are given."""
    poses = flight.poses[rows]
    transforms = rr.Transform3D.columns(
        translation=_raise(poses, flight.facts.body.sensor_height_m), quaternion=yaw_quaternions(poses[:, 2])
    )
    recording.send_columns("world/bat", times, transforms)


def send_trail(recording: rr.RecordingStream, flight: Flight, rows: slice, times: list[rr.TimeColumn]) -> None:
    """Sends what the actions of some steps led to: a piece of trail each; `times` are those of the results."""
    ends = _raise(flight.poses, TRAIL_HEIGHT_M)
    pieces = np.stack([ends[:-1], ends[1:]], axis=1)[rows]
    colours = _colours(np.where(flight.reward_near[rows] != 0, 1, 0), (GREEN, RED))
    recording.send_columns("world/trajectory", times, rr.LineStrips3D.columns(strips=list(pieces), colors=colours))


def send_contacts(recording: rr.RecordingStream, flight: Flight, times: list[rr.TimeColumn]) -> None:
    """Sends a mark wherever an action led into a wall; `times` are those of the contacts."""
    places = _raise(flight.poses[1:][flight.contact], flight.facts.body.sensor_height_m)
    if len(places):
        marks = rr.Points3D(places[:1], labels=["contact"], radii=[0.07], colors=[RED], show_labels=True)
        still = [
            batch for batch in marks.as_component_batches() if "positions" not in str(batch.component_descriptor())
        ]
        recording.log("world/contacts", still, static=True)
        recording.send_columns("world/contacts", times, rr.Points3D.columns(positions=places))


def yaw_quaternions(yaw_rad: NDArray[np.float64]) -> NDArray[np.float32]:
    """Returns float32 (rows, 4): quaternions x, y, z, w of turns about the z axis."""
    quaternions = np.zeros((len(yaw_rad), 4), np.float32)
    quaternions[:, 2], quaternions[:, 3] = np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)
    return quaternions


def rgba(colours: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Returns uint32 (rows,): opaque colours as rerun packs them, from uint8 (rows, 3)."""
    red, green, blue = colours.astype(np.uint32).T
    packed: NDArray[np.uint32] = (red << 24) | (green << 16) | (blue << 8) | np.uint32(255)
    return packed


def _raise(poses: NDArray[np.float64], height_m: float) -> NDArray[np.float32]:
    """float32 (rows, 3): the places of poses at a height."""
    return np.column_stack([poses[:, :2], np.full(len(poses), height_m)]).astype(np.float32)


def _colours(choice: NDArray[np.int64], palette: tuple[Rgb, ...]) -> NDArray[np.uint32]:
    return rgba(np.array(palette, np.uint8)[choice])
