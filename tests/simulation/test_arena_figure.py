"""The drawing of an arena and what is measured for it."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from apex_bat.config.settings import Body
from apex_bat.simulation.arena_figure import draw_arena, lines_across, shortest_lap
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.ground import ground_plan


def test_shortest_lap_round_a_pillar_is_a_circle() -> None:
    lap = shortest_lap(load_arena("circle"), Body())
    length_m = np.hypot(*(np.roll(lap, -1, axis=0) - lap).T).sum()
    assert length_m == pytest.approx(2 * np.pi * (1.07312 + 0.175), rel=0.01)


def test_shortest_lap_is_straight_where_no_wall_holds_it() -> None:
    arena = load_arena("simple")
    lap = shortest_lap(arena, Body())
    bend_m = np.hypot(*((np.roll(lap, 1, axis=0) + np.roll(lap, -1, axis=0)) / 2 - lap).T)
    clearance_m = ground_plan([arena]).clearance_m(lap, np.zeros(len(lap), np.int64))
    assert (clearance_m > 0.175).all()
    assert bend_m[clearance_m > 0.175 + 0.02].max() < 1e-5
    assert bend_m.max() > 1e-3


def test_an_arena_without_a_centre_line_has_no_lap() -> None:
    with pytest.raises(ValueError, match="maze has no centre line"):
        shortest_lap(load_arena("maze"), Body())


def test_clear_widths_of_simple_are_those_of_its_legs() -> None:
    lines = lines_across(load_arena("simple"))
    widths_m = np.hypot(*(lines[:, 0] - lines[:, 1]).T)
    np.testing.assert_allclose(np.sort(widths_m), [1.413, 1.414, 1.43, 1.434, 1.434, 1.781], atol=0.02)


def test_drawing_is_a_picture_that_is_not_blank(tmp_path: Path) -> None:
    draw_arena(load_arena("circle"), tmp_path / "arena.png")
    with Image.open(tmp_path / "arena.png") as picture:
        assert picture.size == (800, 800)
        assert len(picture.convert("RGB").getcolors(maxcolors=1 << 20) or []) > 50
