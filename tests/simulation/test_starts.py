"""Safe starts: clear, with a way out, and spread over the whole drivable region."""

import numpy as np
import pytest
from scipy import ndimage

from apex_bat.config.settings import Body, Episode
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.motion import TURN_SIGN, fly_arc, step_length_m, step_turn_rad
from apex_bat.simulation.starts import StartRegion, connected, start_region

BODY, EPISODE = Body(), Episode()


def region(name: str) -> StartRegion:
    return start_region(load_arena(name), BODY, EPISODE)


def survivors(name: str, starts: np.ndarray, straight_steps: int) -> np.ndarray:
    """Whether a bat flies straight and then ten steps of one action, whichever is best, without touching a wall."""
    ground, count = ground_plan([load_arena(name)]), len(starts)
    survives = np.zeros(count, bool)
    for sign in TURN_SIGN:
        poses, clear = starts, np.ones(count, bool)
        for turn in [0.0] * straight_steps + [sign] * 10:
            poses = fly_arc(poses, np.full(count, turn * step_turn_rad(BODY)), np.full(count, step_length_m(BODY)))
            clear &= ground.clearance_m(poses[:, :2], np.zeros(count, np.int64)) > BODY.diameter_m / 2
        survives |= clear
    return survives


@pytest.mark.parametrize("share_free", [0.3, 0.6, 0.9])
def test_connected_cells_are_those_that_scipy_labels_alike(share_free: float) -> None:
    generator = np.random.default_rng(3)
    for _ in range(20):
        is_free = generator.random(generator.integers(1, 40, 2)) < share_free
        is_free[0, 0] = True
        labels, _ = ndimage.label(is_free)
        column, row = generator.choice(np.argwhere(is_free))
        np.testing.assert_array_equal(connected(is_free, column, row), labels == labels[column, row])


@pytest.mark.parametrize("name", ["simple", "narrow", "maze"])
def test_from_every_start_two_straight_steps_and_then_one_action_held_touch_nothing(name: str) -> None:
    generator = np.random.default_rng(1)
    starts = np.array([region(name).sample(generator) for _ in range(60)])
    ground = ground_plan([load_arena(name)])
    assert ground.clearance_m(starts[:, :2], np.zeros(60, np.int64)).min() > EPISODE.safe_start_m
    assert survivors(name, starts, straight_steps=2).all()


def test_without_listening_steps_some_starts_allow_no_straight_step() -> None:
    hasty = start_region(load_arena("narrow"), BODY, Episode(listening_steps=0))
    generator = np.random.default_rng(1)
    starts = np.array([hasty.sample(generator) for _ in range(60)])
    assert survivors("narrow", starts, straight_steps=0).all()
    assert not survivors("narrow", starts, straight_steps=1).all()


def test_facing_a_wall_is_safe_from_so_far_that_the_bat_may_listen_before_it_turns() -> None:
    wall_m = 4.525  # inner face of the eastern wall of simple
    poses = np.array([[wall_m - 0.5, 0.0, 0.0], [wall_m - 0.5, 0.0, np.pi / 2]])
    np.testing.assert_array_equal(region("simple").is_safe(poses), [False, True])
    facing = np.array([[wall_m - distance_m, 0.0, 0.0] for distance_m in (0.75, 1.0)])
    np.testing.assert_array_equal(region("simple").is_safe(facing), [False, True])
    hasty = start_region(load_arena("simple"), BODY, Episode(listening_steps=0))
    np.testing.assert_array_equal(hasty.is_safe(facing), [True, True])


def test_starts_reach_every_part_of_the_corridor_and_every_heading() -> None:
    generator = np.random.default_rng(2)
    starts = np.array([region("simple").sample(generator) for _ in range(400)])
    legs = [starts[:, 0] > 3.1, starts[:, 1] > 2.8, starts[:, 0] < -3.1, starts[:, 1] < -3.2]
    assert all(leg.sum() > 20 for leg in legs)
    assert np.histogram(starts[:, 2], bins=8, range=(-np.pi, np.pi))[0].min() > 15


def test_starts_are_connected_to_the_arenas_start() -> None:
    cells = region("simple").cells
    is_inside_island = (cells[:, 0] > 0.9) & (cells[:, 0] < 2.9) & (cells[:, 1] > -2.9) & (cells[:, 1] < 2.6)
    assert not is_inside_island.any()


def test_equal_generators_draw_equal_starts() -> None:
    first, second = (region("circle").sample(np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_clearance_of_starts_is_a_setting() -> None:
    wide = start_region(load_arena("simple"), BODY, Episode(safe_start_m=0.6))
    generator = np.random.default_rng(3)
    starts = np.array([wide.sample(generator) for _ in range(30)])
    ground = ground_plan([load_arena("simple")])
    assert ground.clearance_m(starts[:, :2], np.zeros(30, np.int64)).min() > 0.6
