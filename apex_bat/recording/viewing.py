"""Opening recordings in the rerun viewer: repaired where needed, laid out, listening on loopback only."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

import rerun.blueprint as rrb
from rerun.chunk import Chunk, LazyChunkStream
from rerun.experimental import ViewerClient

from apex_bat.recording.blueprints import PAIR
from apex_bat.recording.probing import undecodable
from apex_bat.recording.reading import RecordingError, is_whole, read_chunks, repair_recording

HOST = "127.0.0.1"
LOAD_TIMEOUT_S = 300.0
"""A viewer that is not done by then is left as it is."""
_POLL_S = 0.3
PAIR_APPLICATION_ID = "apex_bat_pair"
"""Two flights in one recording have another layout than one, and a layout belongs to an application."""


def open_viewer(paths: Sequence[Path], layout: Path, *, web: bool) -> int:
    """Opens recordings in a viewer of their own, waits until it is closed, and returns its exit code.

    Args:
        paths: the recordings; the last is shown first (in the browser the viewer decides).
        layout: an .rbl that replaces the layout inside the recordings: the last one wins.
        web: in the browser.
    """
    port = free_port()
    first = paths if web else paths[-1:]
    command = [sys.executable, "-m", "rerun", *map(str, first), str(layout), "--bind", HOST, "--port", str(port)]
    command += ["--web-viewer", "--web-viewer-port", "0"] if web else []
    with subprocess.Popen(command) as viewer:  # noqa: S603  # our own command
        try:
            if len(first) < len(paths):
                _open_others(paths[:-1], viewer, f"rerun+http://{HOST}:{port}/proxy")
            return viewer.wait()
        except BaseException:
            viewer.kill()
            raise


def free_port() -> int:
    """Returns a port of this machine that nobody listens on."""
    with socket.socket() as free:
        free.bind((HOST, 0))
        return int(free.getsockname()[1])


def whole_copies(paths: Sequence[Path], folder: Path) -> list[Path]:
    """Returns the recordings, a repaired copy in the folder in place of each that was cut short.

    Raises:
        RecordingError: one cannot be repaired, or not even read.
    """
    damaged = undecodable(paths)
    if damaged:
        raise RecordingError(f"{damaged[0]}: damaged so that nothing can read it; move it out of its folder")
    return [path if is_whole(path) else _repaired(path, folder) for path in paths]


def save_layout(blueprint: rrb.Blueprint, application_id: str, folder: Path) -> Path:
    """Writes a layout into a folder and returns its path."""
    path = folder / "layout.rbl"
    blueprint.save(application_id, path)
    return path


def write_pair(one: Path, other: Path, path: Path) -> None:
    """Writes a recording that holds two flights side by side: their entities below `a` and below `b`.

    The viewer shows only one recording at a time, so that two can be seen together only in this way.

    Raises:
        RecordingError: one of them cannot be read.
    """
    chunks = LazyChunkStream.from_iter([*_below(PAIR[0], one), *_below(PAIR[1], other)])
    chunks.write_rrd(path, application_id=PAIR_APPLICATION_ID, recording_id=str(uuid.uuid4()))


def _open_others(paths: Sequence[Path], viewer: subprocess.Popen[bytes], url: str) -> None:
    """Opens more recordings when the viewer shows the first, and shows that one again when they are read.

    Given several at once it reads them side by side, shows the one that it happens to end with, and lays it out as that
    one says instead of as the layout does.
    """
    first, deadline_s = "", time.monotonic() + LOAD_TIMEOUT_S
    while viewer.poll() is None and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)
        try:
            client = ViewerClient.connect(url)
            state = client.get_state()
            if state.loading or not state.active_recording:
                continue
            if not first:
                client.open([str(path.absolute()) for path in paths], navigate=False)
                first = next(each.location for each in state.recordings if each.store_id == state.active_recording)
            elif len(state.recordings) > len(paths):
                client.set_location(first)
                return
        except (ConnectionError, RuntimeError, TimeoutError):  # not up yet, or busy
            continue


def _below(prefix: str, path: Path) -> Iterator[Chunk]:
    for chunk in read_chunks(path):
        if not chunk.entity_path.startswith("/__properties"):
            yield chunk.with_entity_path(f"/{prefix}{chunk.entity_path}")


def _repaired(path: Path, folder: Path) -> Path:
    """A copy with an index."""
    copy = folder / f"{path.name.removesuffix('.part').removesuffix('.rrd')}.rrd"
    repair_recording(path, copy)
    return copy
