"""Recordings read back: the flight, and the settings it was flown with. Files cut short give the steps that are whole.

In a file cut short the rows of different entities end at different steps, because entities are sent one after the
other within a block of steps; the flight read from it ends at the last step that all of them reached.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
from numpy.typing import NDArray
from rerun.chunk import Chunk, RrdReader

from apex_bat.config.settings import Body
from apex_bat.config.settings import Sonar as SonarSettings
from apex_bat.experience import NUM_BINS
from apex_bat.recording.columns import images_of, tensors_of
from apex_bat.recording.flight import ACTION_NAMES, Flight, FlightFacts
from apex_bat.recording.probing import undecodable
from apex_bat.recording.series import EAR_NAMES, PROPERTIES_PATH, SERIES, SETTINGS_PATH
from apex_bat.simulation.layout import Arena

REPAIR_TIMEOUT_S = 120.0
_LIES = (
    AttributeError, IndexError, KeyError, MemoryError, OverflowError, TypeError, ValueError, pa.ArrowException,
    msgspec.MsgspecError,
)  # fmt: skip
"""What content raises that could be decoded and is not what it should be."""


class RecordedSettings(msgspec.Struct, frozen=True):
    """The settings that a recording carries."""

    arena: Arena
    body: Body
    sonar: SonarSettings


class RecordingError(ValueError):
    """A file that is no flight recording, or holds no whole step."""


def read_flight(path: Path) -> Flight:
    """Returns the flight of a recording; every array comes back bit for bit.

    Raises:
        RecordingError: names the file and what is wrong with it.
    """
    with _told(path):
        return _flight(path, _read_chunks(path))


def _flight(path: Path, chunks: list[Chunk]) -> Flight:
    known = _properties(path, chunks)
    period = int(known["heavy_period_steps"])
    arrays = _arrays_of_steps(chunks)
    ranges_m = tensors_of(_column(chunks, "/sensor/ranges", "Tensor:data"))
    num_steps = min(len(values) - (name == "poses") for name, values in arrays.items())
    if len(ranges_m):
        num_steps = min(num_steps, len(ranges_m) * period)
    if num_steps < 1:
        raise RecordingError(f"{path}: holds no whole step of a flight")
    contacts = _column(chunks, "/world/contacts", "step").to_pylist()
    return Flight(
        facts=_facts(known, _settings(path, chunks).body),
        end=str(known["end"]) if num_steps == known["steps"] else "",
        heavy_period_steps=period,
        ranges_m=ranges_m[: math.ceil(num_steps / period)] if len(ranges_m) else None,
        contact=np.isin(np.arange(num_steps) + 1, contacts),
        **{name: values[: num_steps + (name == "poses")] for name, values in arrays.items()},
    )


def read_settings(path: Path) -> RecordedSettings:
    """Returns the arena, robot and sonar of a recording.

    Raises:
        RecordingError: names the file and what is wrong with it.
    """
    with _told(path):
        return _settings(path, _read_chunks(path))


def read_properties(path: Path, *, is_tried: bool = False) -> Mapping[str, Any]:
    """Returns what a recording says of the flight as a whole, without reading the rest where it has an index.

    Args:
        path: the recording.
        is_tried: whether `probing.undecodable` was asked about it.

    Raises:
        RecordingError: names the file and what is wrong with it.
    """
    with _told(path):
        return _properties(path, _read_chunks(path, "/__properties/**", is_tried=is_tried))


def read_chunks(path: Path) -> list[Chunk]:
    """Returns all that a recording holds, repaired first where needed.

    Raises:
        RecordingError: names the file and what is wrong with it.
    """
    return _read_chunks(path)


def is_whole(path: Path) -> bool:
    """Says whether a recording was closed properly: whether it has its index, which the viewer wants."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            RrdReader(path).store()
        except (RuntimeError, ValueError):
            return False
    return True


def repair_recording(path: Path, repaired: Path) -> None:
    """Writes a copy of a recording that was cut short, with all that is whole in it and an index.

    Raises:
        RecordingError: nothing in the file can be read.
    """
    command = [sys.executable, "-m", "rerun_cli", "rrd", "optimize", str(path), "-o", str(repaired)]
    try:
        run = subprocess.run(  # noqa: S603  # our own command
            command, capture_output=True, text=True, errors="replace", timeout=REPAIR_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise RecordingError(f"{path}: cannot be repaired within {REPAIR_TIMEOUT_S:g} s") from None
    if run.returncode != 0 or not repaired.is_file():
        reason = next((line for line in reversed(run.stderr.splitlines()) if line.startswith("Error")), "damaged")
        raise RecordingError(f"{path}: cannot be repaired: {reason}")


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Makes one error of all that damaged content raises."""
    try:
        yield
    except RecordingError:
        raise
    except _LIES as error:
        raise RecordingError(f"{path}: damaged: {error}") from error


def _read_chunks(path: Path, content: str | None = None, *, is_tried: bool = False) -> list[Chunk]:
    """The chunks of some entities, in the order in which they were written, repaired first where needed."""
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording")
    if not is_tried and undecodable([path]):
        raise RecordingError(f"{path}: damaged so that nothing can read it; move it out of its folder")
    try:
        try:
            return _stream(path, content)
        except RuntimeError:  # what rerun raises for a message that ends beyond the end of the file
            with tempfile.TemporaryDirectory() as folder:
                repaired = Path(folder, "repaired.rrd")
                repair_recording(path, repaired)
                return _stream(repaired, content)
    except RecordingError:
        raise
    except (RuntimeError, ValueError) as error:
        raise RecordingError(f"{path}: not a rerun recording: {error}") from error


def _stream(path: Path, content: str | None) -> list[Chunk]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "no footer", which is just why the file is read in this way
        return RrdReader(path).stream().filter(content=content).to_chunks()


def _column(chunks: list[Chunk], entity: str, name: str) -> pa.Array:
    """One column of an entity over all its chunks, in the order of the steps; empty when there is none."""
    batches = [chunk.to_record_batch() for chunk in chunks if chunk.entity_path == entity]
    found = [batch for batch in batches if name in batch.schema.names]
    found.sort(key=lambda batch: batch.column("step")[0].as_py() if "step" in batch.schema.names else -1)
    return pa.concat_arrays([batch.column(name) for batch in found]) if found else pa.array([], pa.list_(pa.int64()))


def _arrays_of_steps(chunks: list[Chunk]) -> dict[str, NDArray[Any]]:
    """The arrays of `Flight` with one row a step (`poses`: one more), as long as each of them was written."""
    arrays: dict[str, NDArray[Any]] = {}
    stored = {field.name for field in fields(Flight)}
    for series in SERIES:
        if series.field in stored:
            values = _column(chunks, f"/{series.path}", "Scalars:scalars").flatten().to_numpy()
            shape = (-1, len(series.names)) if len(series.names) > 1 else (-1,)
            arrays[series.field] = values.reshape(shape).astype(np.float64 if series.field == "poses" else np.float32)
    ears = [tensors_of(_column(chunks, f"/echo/{ear}/frame", "BarChart:values")) for ear in EAR_NAMES]
    both = min(map(len, ears))
    arrays["frame"] = np.stack([ear[:both] for ear in ears], axis=1)
    arrays["state"] = images_of(_column(chunks, "/policy/state", "DepthImage:buffer"), NUM_BINS)
    names = _column(chunks, "/policy/action", "StateChange:state").flatten().to_pylist()
    arrays["action"] = np.array([ACTION_NAMES.index(name) for name in names], np.uint8)
    return arrays


def _properties(path: Path, chunks: list[Chunk]) -> Mapping[str, Any]:
    """What is known of the flight as a whole."""
    for chunk in chunks:
        if chunk.entity_path == f"/{PROPERTIES_PATH}":
            row = chunk.to_record_batch().to_pylist()[0]
            return {name: value[0] for name, value in row.items() if isinstance(value, list)}
    raise RecordingError(f"{path}: no flight recording of this project: it has no properties `flight`")


def _facts(known: Mapping[str, Any], body: Body) -> FlightFacts:
    names = {field.name for field in fields(FlightFacts)}
    return FlightFacts(**{name: value for name, value in known.items() if name in names}, body=body)


def _settings(path: Path, chunks: list[Chunk]) -> RecordedSettings:
    text = _column(chunks, f"/{SETTINGS_PATH}", "TextDocument:text").flatten().to_pylist()
    if not text:
        raise RecordingError(f"{path}: no flight recording of this project: it has no entity {SETTINGS_PATH!r}")
    return msgspec.json.decode(text[0], type=RecordedSettings)
