"""A flight as a picture or a film for papers and READMEs: the arena from above, what the bat heard and what it did.

Drawn by matplotlib without any viewer or display. Colours grow lighter with time and with loudness, so that the picture
reads in grey and for the colour-blind.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apex_bat.recording.flight import Flight
from apex_bat.recording.panels import MapPanel, TimePanel
from apex_bat.simulation.layout import Arena

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE_INCHES = (12.0, 5.2)
DPI = 160
FILM_DPI = 80  # 960 x 416 pixels
GIF_IMAGES = 100
GIF_IMAGES_PER_S = 10
MP4_IMAGES_PER_S = 20
LAST_IMAGE_S = 2.0
"""How long a film rests on its last image."""


class FilmError(RuntimeError):
    """A film that cannot be made here."""


def draw_flight(flight: Flight, arena: Arena, path: Path, *, until_step: int | None = None) -> None:
    """Writes a picture of a flight; the suffix of `path` (.png, .pdf, .svg) says in which format.

    Args:
        flight: what happened.
        arena: where.
        path: the file to write.
        until_step: draw only what happened before this step, as in a film; None: everything.
    """
    drawing = _Drawing(flight, arena, DPI)
    drawing.show(flight.num_steps if until_step is None else until_step)
    drawing.figure.savefig(path)


def write_gif(flight: Flight, arena: Arena, path: Path) -> None:
    """Writes a film of a flight as an animated GIF of at most 100 images, ten a second."""
    from PIL import Image

    images = [Image.fromarray(image) for image in _images(flight, arena, GIF_IMAGES)]
    # One palette for all, from the last image, which has every colour: else they flicker.
    palette = images[-1].quantize(255)
    indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations_ms = [1000 // GIF_IMAGES_PER_S] * (len(indexed) - 1) + [round(1000 * LAST_IMAGE_S)]
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations_ms, loop=0, optimize=True)


def write_mp4(flight: Flight, arena: Arena, path: Path) -> None:
    """Writes a film of a flight as H.264 in real time, an image for each call, with the program ffmpeg.

    Raises:
        FilmError: there is no ffmpeg, or it fails.
    """
    program = shutil.which("ffmpeg")
    if program is None:
        raise FilmError(f"{path}: an mp4 needs the program ffmpeg, which is not installed; --gif does without")
    height, width = round(SIZE_INCHES[1] * FILM_DPI), round(SIZE_INCHES[0] * FILM_DPI)
    command = [
        program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", str(MP4_IMAGES_PER_S), "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path),
    ]  # fmt: skip
    with tempfile.TemporaryFile() as log:
        with (
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log) as ffmpeg,  # noqa: S603  # our own
            suppress(BrokenPipeError),  # it has failed, and says why in its log
        ):
            _feed(ffmpeg, _images(flight, arena, flight.num_steps))
        if ffmpeg.returncode != 0:
            log.seek(0)
            raise FilmError(f"{path}: ffmpeg failed: {log.read().decode(errors='replace').strip()}")


def _feed(ffmpeg: subprocess.Popen[bytes], images: Iterator[NDArray[np.uint8]]) -> None:
    """Hands one image after the other to ffmpeg, the last one for as long as the film rests."""
    assert ffmpeg.stdin is not None  # noqa: S101
    with ffmpeg.stdin as film:
        for image in images:
            film.write(image.tobytes())
        for _ in range(round(LAST_IMAGE_S * MP4_IMAGES_PER_S)):
            film.write(image.tobytes())


def _images(flight: Flight, arena: Arena, most: int) -> Iterator[NDArray[np.uint8]]:
    """uint8 (height, width, 3): at most so many images, evenly spaced over the steps, the last one the whole flight."""
    drawing = _Drawing(flight, arena, FILM_DPI)
    for step in np.linspace(1, flight.num_steps, min(most, flight.num_steps)).round().astype(int).tolist():
        drawing.show(step)
        yield drawing.pixels()


class _Drawing:
    """The figure of a flight."""

    def __init__(self, flight: Flight, arena: Arena, dpi: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.figure: Figure = Figure(figsize=SIZE_INCHES, dpi=dpi, layout="constrained")
        self._canvas: Any = FigureCanvasAgg(self.figure)  # much of it is not typed
        self._still: Any = None
        self._num_steps = flight.num_steps
        grid = self.figure.add_gridspec(4, 2, width_ratios=[1.0, 1.5], height_ratios=[4, 4, 0.5, 2.2])
        left = self.figure.add_subplot(grid[0, 1])
        others = [self.figure.add_subplot(grid[row, 1], sharex=left) for row in (1, 2, 3)]
        self._panels = (
            MapPanel(self.figure.add_subplot(grid[:, 0]), flight, arena),
            TimePanel(left, others[0], others[1], others[2], flight),
        )

    def show(self, step: int) -> None:
        """Shows what happened before a step."""
        for panel in self._panels:
            panel.show(min(max(step, 1), self._num_steps))

    def pixels(self) -> NDArray[np.uint8]:
        """Returns uint8 (height, width, 3); all but the first time, only what moves is drawn anew."""
        moving = [artist for panel in self._panels for artist in panel.moving]
        if self._still is None:
            for artist in moving:
                artist.set_animated(True)
            self._canvas.draw()
            self._still = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._still)
        for artist in moving:
            artist.draw(self._canvas.get_renderer())
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
