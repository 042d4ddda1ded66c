"""Pictures of what the rerun viewer shows, taken without a display: for documents, and to see what a layout reports.

The viewer draws offscreen with Vulkan; on a machine without a GPU, Mesa's software driver does (on Debian the packages
libvulkan1 and mesa-vulkan-drivers).
"""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
import rerun_cli  # type: ignore[import-untyped]
from rerun.experimental import ViewerClient

from apex_bat.recording.viewing import HOST, free_port

SIZE = (1600, 900)
TIMEOUT_S = 120.0
_POLL_S = 0.3
_SETTLE_S = 6.0  # chunks are fetched on demand, views find their ranges over some images, a greeting fades
_Answer = TypeVar("_Answer")


class ScreenshotError(RuntimeError):
    """The viewer did not start, or did not show the recording in time."""


def take_screenshot(paths: Sequence[Path], picture: Path, at: float | None = None) -> list[str]:
    """Writes a picture of the viewer and returns what its views warn of, a line each.

    Args:
        paths: recordings and layouts as one gives them to `rerun`: the last layout wins.
        picture: the .png to write.
        at: where on the timeline of the layout: a step, or a time in s; None: where the viewer begins.

    Raises:
        ScreenshotError: the viewer does not start here, shows no recording, or one that is shorter than `at`.
    """
    deadline_s = time.monotonic() + TIMEOUT_S
    with _viewer(paths) as (process, url, log):

        def patiently(ask: Callable[[], _Answer | None], what: str) -> _Answer:
            """The viewer's answer; before its first image, and under load, it gives none."""
            while True:
                try:
                    answer = ask()
                except ScreenshotError:
                    raise
                except (ConnectionError, RuntimeError, TimeoutError) as error:
                    answer, reason = None, str(error)
                else:
                    reason = "not yet"
                if answer is not None:
                    return answer
                if process.poll() is not None or time.monotonic() > deadline_s:
                    raise ScreenshotError(f"{what}: {reason}; the viewer said {log.read_text(errors='replace')[-500:]}")
                time.sleep(_POLL_S)

        client = patiently(lambda: ViewerClient.connect(url), "starting the viewer")
        patiently(lambda: _shown(client), "loading")
        if at is not None:
            patiently(lambda: _go_to(client, at), "going to the time")
        time.sleep(_SETTLE_S)
        _save(patiently(client.take_screenshot, "taking the picture"), picture)
        views = patiently(client.get_state, "asking for warnings").views
        return [f"{view.name}: {report.severity}: {report.summary}" for view in views for report in view.reports]


@contextmanager
def _viewer(paths: Sequence[Path]) -> Iterator[tuple[subprocess.Popen[bytes], str, Path]]:
    """A viewer without a window on this machine's own address; ended with the block."""
    port = free_port()
    program = shutil.which("rerun", path=str(Path(rerun_cli.__file__).parent)) or "rerun"
    size = "x".join(map(str, SIZE))
    command = [program, *map(str, paths), "--headless", "--bind", HOST, "--port", str(port),
               "--window-size", size, "--hide-welcome-screen"]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "viewer.log")
        with log.open("wb") as out:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out)  # noqa: S603  # our own
            try:
                yield process, f"rerun+http://{HOST}:{port}/proxy", log
            finally:
                process.kill()
                process.wait()


def _shown(client: ViewerClient) -> bool | None:
    """True when a recording is on show and all is loaded."""
    state = client.get_state()
    has_times = any(recording.timelines for recording in state.recordings)
    return True if state.active_recording and not state.loading and has_times else None


def _save(screenshot: bytes, picture: Path) -> None:
    """Writes a picture without its transparency, which nothing needs, packed well: two thirds of the size."""
    from PIL import Image

    Image.open(io.BytesIO(screenshot)).convert("RGB").save(picture, optimize=True)


def _go_to(client: ViewerClient, at: float) -> bool:
    state = client.get_state()
    shown = next(each for each in state.recordings if each.store_id == state.active_recording)
    timeline = next(each for each in shown.timelines if each.name == shown.current_timeline)
    per_unit = 1.0 if timeline.time_type == "sequence" else 1e9
    if timeline.end is not None and at * per_unit > timeline.end:
        raise ScreenshotError(f"there is no {timeline.name} {at:g}; the last is {timeline.end / per_unit:g}")
    if timeline.time_type == "sequence":
        client.set_time(timeline.name, play_state="paused", sequence=round(at))
    else:
        client.set_time(timeline.name, play_state="paused", duration=np.timedelta64(round(1e9 * at), "ns"))
    return True
