"""Colours of levels, and where the rays point."""

from __future__ import annotations

import numpy as np

from apex_bat.recording.hearing import LEVEL_RAMP, SILENT_COLOUR, Directions, level_colours


def test_louder_points_are_lighter() -> None:
    packed = level_colours(np.linspace(20.0, 80.0, 50))
    red, green, blue = packed >> 24, packed >> 16 & 255, packed >> 8 & 255
    luminance = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    assert (np.diff(luminance) > 0).all()


def test_ramp_ends_at_its_colours_and_beyond() -> None:
    for level_db, colour in [(20.0, LEVEL_RAMP[0]), (80.0, LEVEL_RAMP[-1]), (120.0, LEVEL_RAMP[-1])]:
        assert _channels(level_colours(np.array([level_db]))[0]) == [int(channel) for channel in colour]


def test_unheard_points_are_grey() -> None:
    for level_db in (-np.inf, 19.9):
        assert _channels(level_colours(np.array([level_db]))[0]) == list(SILENT_COLOUR)


def test_rays_point_forward_left_and_up() -> None:
    ahead, left, up = Directions(np.array([0.0, np.pi / 2, 0.0]), np.array([0.0, 0.0, np.pi / 2])).unit_vectors()
    np.testing.assert_allclose(ahead, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(left, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-12)


def _channels(packed: np.uint32) -> list[int]:
    assert packed & 255 == 255
    return [int(packed >> shift & 255) for shift in (24, 16, 8)]
