"""Streaming a run to a viewer that is open on this machine: the training curves and one flight after the other.

The streamer is a process of its own that reads what the run writes to its folder and sends that on. Nobody waits for
it: a viewer that is slow, closed or was never opened can hold up the streamer only. A viewer that is opened later gets
everything from the start.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import rerun as rr
from rerun.chunk import RrdReader

from apex_bat import config as configuration
from apex_bat.recording.blueprints import APPLICATION_ID, flight_blueprint, training_blueprint
from apex_bat.recording.curves import TRAINING_APPLICATION_ID, TrainingCurves
from apex_bat.recording.orphans import drop_orphans
from apex_bat.recording.reading import RecordingError, is_whole, read_settings
from apex_bat.recording.training import row_of
from apex_bat.storage import StorageError, read_json

HOST = "127.0.0.1"
PORT = 9876
"""Where a rerun viewer listens unless told otherwise."""
PERIOD_S = 2.0
STEP_TIMEOUT_S = 30.0
"""A viewer that has not taken what it was sent after this long is given up."""
RETRY_S = 300.0
"""How long it is left alone then."""
_CONNECT_TIMEOUT_S = 0.5
_NICENESS = 10  # training comes first
_STOP_TIMEOUT_S = 3.0
_log = logging.getLogger(__name__)


def stream_run(run: Path, port: int = PORT, *, leash: bool = False) -> bool:
    """Streams a run until it ends; waits for a viewer as long as there is none.

    Args:
        run: the run folder.
        port: of the viewer, on this machine.
        leash: end also when standard input ends, and leave the processor to others.

    Returns:
        Whether all threads ended; if not, one hangs within rerun on a viewer that takes nothing, which would also hold
        up the end of the process: leave it by `os._exit`.

    Raises:
        ConfigError: the folder holds no run whose settings can be read.
    """
    stop = threading.Event()
    if leash:
        if hasattr(os, "nice"):
            os.nice(_NICENESS)
        threading.Thread(target=_wait_for_end_of_input, args=(stop,), daemon=True).start()
    stream, hangs, due_s = RunStream(run, port), False, 0.0
    while True:
        is_last = stop.is_set() or not _is_running(run)
        if time.monotonic() >= due_s and not _ends_in_time(stream.step):
            _log.warning("the viewer takes nothing; it is left alone for %g s", RETRY_S)
            stream, hangs, due_s = RunStream(run, port), True, time.monotonic() + RETRY_S
        if is_last:
            return _ends_in_time(stream.close) and not hangs
        stop.wait(PERIOD_S)


@contextmanager
def streamer(run: Path, port: int = PORT) -> Iterator[None]:
    """Runs the streamer of a run beside the block, as a process; what it has to say goes to logs/stream.log."""
    command = [sys.executable, "-m", "apex_bat", "inspect", str(run), "--live", "--leash", "--port", str(port)]
    with (run / "logs" / "stream.log").open("ab") as log:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log)  # noqa: S603  # our own
    try:
        yield
    finally:
        if process.stdin is not None:
            process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            process.wait(_STOP_TIMEOUT_S)
        process.kill()
        process.wait()


class RunStream:
    """What of a run was sent to the viewer that is open now."""

    def __init__(self, run: Path, port: int) -> None:
        self._run, self._port = run, port
        self._url = f"rerun+http://{HOST}:{port}/proxy"
        self._config = configuration.load(run / "config.toml")
        self._training: rr.RecordingStream | None = None
        self._curves: TrainingCurves | None = None
        self._offsets: dict[Path, int] = {}
        self._sent: Path | None = None

    @property
    def is_connected(self) -> bool:
        """Whether there was a viewer at the last step."""
        return self._training is not None

    def step(self) -> None:
        """Sends what is new; with no viewer, or with one that takes nothing, everything is to be sent anew."""
        if not _is_listening(self._port):
            self._forget()
            return
        try:
            self._send_rows()
            self._send_flight()
        except RuntimeError as error:  # rerun's, for a viewer that went away
            _log.warning("the viewer takes nothing: %s", error)
            self._forget()

    def close(self) -> None:
        """Ends the stream."""
        self._forget()

    def _send_rows(self) -> None:
        if self._training is None:
            self._training = rr.RecordingStream(TRAINING_APPLICATION_ID, recording_id=uuid.uuid4())
            self._training.connect_grpc(self._url, default_blueprint=training_blueprint(self._config))
            self._curves = TrainingCurves(self._training, self._config, self._run.name)
        if self._curves is not None:
            for row in self._new_rows():
                self._curves.take(row)
            self._curves.flush()
            self._training.flush(timeout_sec=STEP_TIMEOUT_S)

    def _new_rows(self) -> Iterator[dict[str, Any]]:
        for path in sorted((self._run / "metrics").glob("*.jsonl")):
            with path.open("rb") as file:
                file.seek(self._offsets.get(path, 0))
                for line in file:
                    if not line.endswith(b"\n"):  # still being written
                        break
                    self._offsets[path] = self._offsets.get(path, 0) + len(line)
                    row = row_of(line)
                    if row is not None:
                        yield row

    def _send_flight(self) -> None:
        """Sends the newest evaluation flight, if it is a new one."""
        paths = [path for path in (self._run / "recordings").glob("evaluation-*.rrd") if is_whole(path)]
        newest = max(paths, key=lambda path: path.stat().st_mtime_ns, default=None)
        if newest is None or newest == self._sent:
            return
        try:
            self._send(newest)
        except (RecordingError, OSError) as error:  # deleted meanwhile, for want of room
            _log.warning("not sent: %s", error)
            return
        drop_orphans()
        self._sent = newest

    def _send(self, path: Path) -> None:
        arena = read_settings(path).arena
        reader = RrdReader(path)
        flight = rr.RecordingStream(APPLICATION_ID, recording_id=reader.recordings()[0].recording_id)
        flight.connect_grpc(self._url, default_blueprint=flight_blueprint(arena, is_playing=True))
        flight.send_chunks(reader.stream())
        flight.flush(timeout_sec=STEP_TIMEOUT_S)
        flight.disconnect()

    def _forget(self) -> None:
        if self._training is not None:
            with suppress(RuntimeError):
                self._training.disconnect()
        self._training = self._curves = self._sent = None
        self._offsets.clear()


def _ends_in_time(work: Callable[[], None]) -> bool:
    """Whether some work on the viewer ends in time; if not, it is left behind in a thread: rerun waits for ever."""
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    thread.join(STEP_TIMEOUT_S)
    return not thread.is_alive()


def _is_listening(port: int) -> bool:
    try:
        socket.create_connection((HOST, port), _CONNECT_TIMEOUT_S).close()
    except OSError:
        return False
    return True


def _is_running(run: Path) -> bool:
    """Whether the run's launcher has not yet noted how it ended."""
    try:
        return bool(read_json(run / "run.json").get("outcome") == "running")
    except StorageError:
        return False


def _wait_for_end_of_input(stop: threading.Event) -> None:
    while sys.stdin.buffer.read(1):
        pass
    stop.set()
