"""The drawing of an echo's stages."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from apex_bat.simulation.echo_figure import draw_echo
from apex_bat.simulation.sonar import Sonar

AHEAD, NEAR = np.zeros(1), np.ones(1)
"""Angles and range of a point straight ahead, at 1 m."""


def test_drawing_is_a_picture_with_the_colours_of_both_ears(tmp_path: Path) -> None:
    draw_echo(Sonar().hear(AHEAD, AHEAD, NEAR), tmp_path / "echo.png")
    with Image.open(tmp_path / "echo.png") as picture:
        colours = {colour for _, colour in picture.convert("RGB").getcolors(maxcolors=1 << 20) or []}
    assert {(0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)} <= colours


def test_the_exact_rendering_has_no_sound_to_draw(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rendering thesis"):
        draw_echo(Sonar(rendering="exact").hear(AHEAD, AHEAD, NEAR), tmp_path / "echo.png")
    with pytest.raises(ValueError, match="one bat"):
        draw_echo(Sonar().hear(AHEAD[None], AHEAD[None], NEAR[None]), tmp_path / "echo.png")
