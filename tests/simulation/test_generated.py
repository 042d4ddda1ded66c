"""Generated arenas: equal from equal seeds, and fit to fly in."""

import numpy as np
import pytest

from apex_bat.config.settings import Body, Episode
from apex_bat.simulation.generated import CORRIDOR_WIDTH_M, FAMILIES, FOREST_GAP_M, generate_arena
from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import ArenaError
from apex_bat.simulation.starts import start_region

SEEDS = range(12)


@pytest.mark.parametrize("family", FAMILIES)
def test_equal_seeds_give_equal_arenas_and_others_different_ones(family: str) -> None:
    first = generate_arena(family, 4)
    generate_arena.cache_clear()
    assert generate_arena(family, 4) == first
    assert len({generate_arena(family, seed).walls + generate_arena(family, seed).pillars for seed in SEEDS}) == len(
        SEEDS
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_generated_arena_has_safe_starts(family: str) -> None:
    for seed in SEEDS[:4]:
        try:
            start_region(generate_arena(family, seed), Body(), Episode())
        except ArenaError as error:
            pytest.fail(str(error))


def test_generated_corridor_is_a_closed_loop_wide_enough_all_along() -> None:
    for seed in SEEDS:
        arena = generate_arena("corridor", seed)
        line = np.array(arena.centre_line)
        points = np.concatenate([line + share * (np.roll(line, -1, axis=0) - line) for share in np.linspace(0, 1, 100)])
        clearance_m = ground_plan([arena]).clearance_m(points, np.zeros(len(points), np.int64))
        assert clearance_m.min() > 0.45 * CORRIDOR_WIDTH_M[0]
        x, y = line.T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0.0, "the line must run counter-clockwise"


def test_no_way_leads_out_of_a_generated_corridor() -> None:
    for seed in SEEDS[:4]:
        arena = generate_arena("corridor", seed)
        cells = start_region(arena, Body(), Episode()).cells
        nearest = np.hypot(*(cells[:, None] - np.array(arena.centre_line)[None]).transpose(2, 0, 1)).min()
        assert nearest < 0.1, "the region must hold the line"
        assert np.hypot(*cells.T).min() > 0.5, "the region must not reach the middle of the loop"


def test_corridors_turn_both_ways_and_vary_in_width() -> None:
    turns, widths_m = [], []
    for seed in SEEDS:
        arena = generate_arena("corridor", seed)
        leg = np.roll(np.array(arena.centre_line), -1, axis=0) - np.array(arena.centre_line)
        turns += list(np.sign(leg[:, 0] * np.roll(leg[:, 1], -1) - leg[:, 1] * np.roll(leg[:, 0], -1)))
        middles = np.array(arena.centre_line) + leg / 2
        widths_m += list(2 * ground_plan([arena]).clearance_m(middles, np.zeros(len(leg), np.int64)))
    assert {-1.0, 1.0} <= set(turns)
    assert np.ptp(widths_m) > 0.3


def test_pillars_of_a_forest_leave_room_between_them() -> None:
    for seed in SEEDS:
        pillars = np.array(generate_arena("forest", seed).pillars)
        x, y, radius_m, _ = pillars.T
        gap_m = np.hypot(x[:, None] - x, y[:, None] - y) - radius_m[:, None] - radius_m
        assert len(pillars) >= 10
        assert gap_m[~np.eye(len(pillars), dtype=bool)].min() > FOREST_GAP_M - 0.01
