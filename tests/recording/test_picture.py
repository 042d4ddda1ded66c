"""The picture of a flight is drawn without a display and shows what differs."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from numpy.typing import NDArray
from PIL import Image

from apex_bat.recording.flight import Flight
from apex_bat.recording.picture import FilmError, draw_flight, write_gif, write_mp4
from apex_bat.recording.series import RED
from apex_bat.simulation.layout import Arena


def test_contact_is_marked_on_the_map_and_only_then(fly: Callable[..., Flight], room: Arena, tmp_path: Path) -> None:
    flight = fly(20)
    crashed = _red_on_the_map(_draw(flight, room, tmp_path / "a.png"))
    flight.contact[:] = False
    assert _red_on_the_map(_draw(flight, room, tmp_path / "b.png")) == 0
    assert crashed > 50


def test_picture_until_a_step_does_not_show_the_contact_after_it(
    fly: Callable[..., Flight], room: Arena, tmp_path: Path
) -> None:
    assert _red_on_the_map(_draw(fly(20), room, tmp_path / "a.png", until_step=10)) == 0


def test_one_step_is_enough_for_a_picture(fly: Callable[..., Flight], room: Arena, tmp_path: Path) -> None:
    assert _draw(fly(1), room, tmp_path / "a.png").ndim == 3


def test_picture_for_print_has_the_format_of_its_suffix(
    fly: Callable[..., Flight], room: Arena, tmp_path: Path
) -> None:
    draw_flight(fly(5), room, tmp_path / "a.svg")
    assert b"<svg" in (tmp_path / "a.svg").read_bytes()[:1000]


def test_film_moves_and_rests_at_its_end(fly: Callable[..., Flight], room: Arena, tmp_path: Path) -> None:
    write_gif(fly(8), room, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert getattr(film, "n_frames", 1) == 8
        durations_ms, images = [], []
        for number in range(8):
            film.seek(number)
            durations_ms.append(film.info["duration"])
            images.append(np.asarray(film.convert("RGB")))
    assert durations_ms == [100] * 7 + [2000]
    assert all((one != other).any() for one, other in itertools.pairwise(images))


def test_mp4_without_ffmpeg_says_so(
    fly: Callable[..., Flight], room: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FilmError, match="needs the program ffmpeg"):
        write_mp4(fly(2), room, tmp_path / "a.mp4")


def test_mp4_gets_every_image_and_the_word_of_a_failing_ffmpeg(
    fly: Callable[..., Flight], room: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n/usr/bin/env -i /bin/cat > '{tmp_path}/raw'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    write_mp4(fly(3), room, tmp_path / "a.mp4")
    assert (tmp_path / "raw").stat().st_size == (3 + 40) * 960 * 416 * 3
    program.write_text("#!/bin/sh\necho no such codec >&2\nexit 1\n")
    with pytest.raises(FilmError, match="no such codec"):
        write_mp4(fly(3), room, tmp_path / "a.mp4")


def _draw(flight: Flight, arena: Arena, path: Path, until_step: int | None = None) -> NDArray[np.float32]:
    draw_flight(flight, arena, path, until_step=until_step)
    return np.asarray(image.imread(path), np.float32)


def _red_on_the_map(picture: NDArray[np.float32]) -> int:
    """Pixels in the left third that have exactly the colour of marks of contact."""
    left = picture[:, : picture.shape[1] // 3, :3]
    return int((np.abs(left - np.array(RED) / 255) < 0.01).all(axis=-1).sum())
