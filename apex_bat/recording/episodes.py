"""Flights as rerun recordings: one .rrd an episode, written in blocks of steps once the flight is over.

Every file is a recording of its own (a fresh recording id) of one application, so that the viewer lists them as a
table of episodes. Paths, units and timelines are documented in docs/recordings.md.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.recording import hearing, scene, stages
from apex_bat.recording.blueprints import APPLICATION_ID, flight_blueprint
from apex_bat.recording.columns import tensor_columns
from apex_bat.recording.flight import ACTION_NAMES, Flight
from apex_bat.recording.hearing import Directions
from apex_bat.recording.orphans import drop_orphans, save
from apex_bat.recording.series import ACTION_COLOURS, SERIES, SETTINGS_PATH
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.sonar import Sonar

ACTION_LETTERS = ("S", "L", "R")  # whole words are cut off in a lane
BLOCK_STEPS = 100
"""Steps sent together: few enough that a file cut short keeps its first blocks, enough that sending is cheap."""


def write_flight(flight: Flight, arena: Arena, sonar: settings.Sonar, directions: Directions, path: Path) -> None:
    """Writes the recording of a flight. The file appears under its name only when it is whole.

    Args:
        flight: what happened.
        arena: where.
        sonar: the ear that heard; the stages before the echo frames are computed with it from `flight.ranges_m`.
        directions: of the rays of `flight.ranges_m`.
        path: the .rrd to write; its folder exists.

    Raises:
        ValueError: `directions` does not fit `flight.ranges_m`.
        OSError: the file cannot be written.
    """
    if flight.ranges_m is not None and flight.ranges_m.shape[1] != len(directions.azimuth_rad):
        raise ValueError(
            f"the flight has ranges of {flight.ranges_m.shape[1]} rays and there are {len(directions.azimuth_rad)}"
            " directions; give those of its own range sensor"
        )
    part = path.with_name(path.name + ".part")
    try:
        _write(flight, arena, sonar, directions, part)
        part.replace(path)
    except RuntimeError as error:  # rerun's, for a full disk or a missing folder
        raise OSError(f"{path}: the recording cannot be written: {error}") from error
    finally:
        drop_orphans()
        part.unlink(missing_ok=True)


def _write(flight: Flight, arena: Arena, sonar: settings.Sonar, directions: Directions, path: Path) -> None:
    recording = rr.RecordingStream(APPLICATION_ID, recording_id=uuid.uuid4())
    try:
        save(recording, path, flight_blueprint(arena), APPLICATION_ID)
        _send_all(recording, flight, arena, sonar, directions)
        recording.flush()
    finally:
        recording.disconnect()


def _send_all(
    recording: rr.RecordingStream, flight: Flight, arena: Arena, sonar: settings.Sonar, directions: Directions
) -> None:
    _send_properties(recording, flight)
    settings_text = msgspec.json.encode({"arena": arena, "body": flight.facts.body, "sonar": sonar}).decode()
    recording.log(SETTINGS_PATH, rr.TextDocument(settings_text, media_type="application/json"), static=True)
    scene.log_arena(recording, arena)
    scene.log_bat(recording, flight.facts.body)
    ear = Sonar(msgspec.structs.replace(sonar, rendering="thesis"))
    hearing.log_frame_styles(recording, flight.state.shape[1])
    _log_series_styles(recording)
    recording.flush()  # what is logged is gathered and would come after what is sent, and be lost first in a kill
    for rows in _blocks(flight.num_steps):
        _send_block(recording, flight, rows)
        _send_heavy(recording, flight, rows, ear, directions)
    contacts = np.flatnonzero(flight.contact) + 1
    scene.send_contacts(recording, flight, _times(flight, contacts))
    _send_events(recording, flight)


def _blocks(num_steps: int) -> Iterator[slice]:
    for first in range(0, num_steps, BLOCK_STEPS):
        yield slice(first, min(first + BLOCK_STEPS, num_steps))


def _send_block(recording: rr.RecordingStream, flight: Flight, rows: slice) -> None:
    """Sends what every step leaves: scalars, pose, trail, action, frames and state."""
    calls = np.arange(rows.start, rows.stop)
    results = calls + 1
    is_last = rows.stop == flight.num_steps
    poses = np.append(calls, flight.num_steps) if is_last else calls
    for series in SERIES:
        steps = {"call": calls, "result": results, "pose": poses}[series.when]
        values = getattr(flight, series.field)[poses if series.when == "pose" else rows]
        columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition([len(series.names)] * len(values))
        recording.send_columns(series.path, _times(flight, steps), columns)
    scene.send_motion(recording, flight, slice(rows.start, poses[-1] + 1), _times(flight, poses))
    scene.send_trail(recording, flight, rows, _times(flight, results))
    hearing.send_frames(recording, flight, rows, _times(flight, calls))
    names = [ACTION_NAMES[action] for action in flight.action[rows]]
    recording.send_columns("policy/action", _times(flight, calls), rr.StateChange.columns(state=names))


def _send_heavy(recording: rr.RecordingStream, flight: Flight, rows: slice, ear: Sonar, directions: Directions) -> None:
    """Sends the ranges that were kept within a block, and the points, waveforms and cochleagrams they lead to."""
    steps = flight.heavy_steps
    chosen = (steps >= rows.start) & (steps < rows.stop)
    if flight.ranges_m is None or not chosen.any():
        return
    times, ranges_m = _times(flight, steps[chosen]), flight.ranges_m[chosen]
    recording.send_columns("sensor/ranges", times, tensor_columns("Tensor", ranges_m))  # all else follows from them
    generator = np.random.default_rng([flight.facts.seed, rows.start])
    azimuth_rad, elevation_rad = (np.broadcast_to(angle, ranges_m.shape) for angle in directions)
    echo = ear.hear(azimuth_rad, elevation_rad, ranges_m, generator)
    if rows.start == 0:
        stages.log_stage_styles(recording, echo)
    hearing.send_points(recording, ranges_m, echo.level_db, directions, times)
    stages.send_stages(recording, echo, times)


def _times(flight: Flight, steps: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """Both timelines at some steps, from 0 at the first call."""
    seconds = flight.times_s[steps]
    return [rr.TimeColumn("step", sequence=steps), rr.TimeColumn("sim_time", duration=seconds)]


def _log_series_styles(recording: rr.RecordingStream) -> None:
    for series in SERIES:
        if series.marker:
            style: rr.AsComponents = rr.SeriesPoints(
                colors=series.colours, names=series.names, markers=["circle"], marker_sizes=[2.5]
            )
        else:
            style = rr.SeriesLines(
                colors=series.colours,
                names=series.names,
                widths=[1.5] * len(series.names),
                aggregation_policy="MinMax",  # their mean would show rewards that were never given
                interpolation_mode="StepBefore" if series.field.startswith("reward_") else "Linear",
            )
        recording.log(series.path, style, static=True)
    actions = rr.StateConfiguration(values=ACTION_NAMES, labels=ACTION_LETTERS, colors=ACTION_COLOURS)
    recording.log("policy/action", actions, static=True)


def _send_properties(recording: rr.RecordingStream, flight: Flight) -> None:
    """Sends what the viewer's table of episodes shows and sorts by; what is unknown is left out."""
    facts = flight.facts
    known = {
        "arena": facts.arena,
        "condition": facts.condition,
        "kind": facts.kind,
        "seed": facts.seed,
        "episode": facts.episode,
        "mark": facts.mark or None,
        "actor": facts.actor,
        "epsilon": facts.epsilon,
        "checkpoint_step": facts.checkpoint_step,
        "end": flight.end,
        "steps": flight.num_steps,
        "return": float(flight.returns[-1]),
        "progress_m": float(flight.progress_m[-1]),
        "distance_m": float(flight.distance_m[-1]),
        "collided": bool(flight.contact.any()),
        "start_x_m": float(flight.poses[0, 0]),
        "start_y_m": float(flight.poses[0, 1]),
        "start_heading_rad": float(flight.poses[0, 2]),
        "heavy_period_steps": flight.heavy_period_steps,
    }
    values: dict[str, Any] = {name: value for name, value in known.items() if value is not None}
    recording.send_property("flight", rr.AnyValues(**values))
    recording.send_recording_name(_name(flight))


def _name(flight: Flight) -> str:
    """What the viewer lists the recording as; the list is narrow, so that what tells flights apart comes first."""
    facts = flight.facts
    number = f"{facts.episode}" if facts.kind == "evaluation" else f"training {facts.episode}"
    weights = "" if facts.checkpoint_step is None else f", update {facts.checkpoint_step}"
    return f"{number} {facts.mark or flight.end or 'broken off'}, {facts.arena}, {facts.condition}{weights}"


def _send_events(recording: rr.RecordingStream, flight: Flight) -> None:
    """Sends the start, each entry into nearness, contacts and the end as lines of text."""
    facts = flight.facts
    is_near = flight.reward_near != 0
    entered = np.flatnonzero(is_near & ~np.append(False, is_near[:-1])) + 1
    contacts = np.flatnonzero(flight.contact) + 1
    events = [(0, "INFO", f"start in {facts.arena}, condition {facts.condition}, seed {facts.seed}")]
    events += [(int(step), "WARN", f"near a wall, {flight.clearance_m[step - 1]:.2f} m") for step in entered]
    events += [(int(step), "ERROR", "contact") for step in contacts]
    events += [(flight.num_steps, "INFO", f"end: {flight.end or 'broken off'}")]
    events.sort(key=lambda event: event[0])
    steps, levels, texts = zip(*events, strict=True)
    named = [f"step {step}: {text}" for step, text in zip(steps, texts, strict=True)]
    columns = rr.TextLog.columns(text=named, level=levels)
    recording.send_columns("events", _times(flight, np.array(steps)), columns)
