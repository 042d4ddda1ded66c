"""The colony: what the environments do not show."""

import numpy as np
import pybullet

from apex_bat.config.settings import Rays
from apex_bat.simulation.arenas import load_arenas
from apex_bat.simulation.colony import Colony

FEW = Rays(num_azimuth=20, num_elevation=4, num_clearance=90)


def test_bodies_stand_where_the_bats_are() -> None:
    colony = Colony(3, load_arenas("simple,circle"), rays=FEW)
    colony.begin(np.arange(3))
    for _ in range(3):
        colony.step(np.array([0, 1, 2]))
    colony.world.show_bats()
    for bat, body in enumerate(colony.world.bats):
        place, _ = pybullet.getBasePositionAndOrientation(body, physicsClientId=colony.world.client)
        offset = colony.world.offsets_m[colony.arena_index[bat]]
        np.testing.assert_allclose(place[:2], colony.poses[bat, :2] + offset, atol=1e-9)
    colony.close()


def test_given_poses_are_flown_from() -> None:
    colony = Colony(2, load_arenas("simple"), rays=FEW)
    colony.begin(np.array([1]), np.array([[3.8, 1.0, 0.5]]))
    np.testing.assert_array_equal(colony.poses[1], [3.8, 1.0, 0.5])
    colony.close()


def test_bats_that_restart_ignore_their_action_and_earn_nothing() -> None:
    colony = Colony(2, load_arenas("simple"), rays=FEW)
    colony.begin(np.arange(2))
    colony.step(np.array([1, 1]))
    colony.step(np.array([1, 1]), restart=np.array([0]))
    np.testing.assert_array_equal(colony.steps, [0, 2])
    assert colony.rewards.total[0] == 0.0
    assert colony.observation()["actions"].tolist() == [[0, 0, 0], [0, 1, 1]]
    colony.close()


def test_reports_are_copies() -> None:
    colony = Colony(1, load_arenas("simple"), rays=FEW)
    colony.begin(np.arange(1))
    for values in (*colony.report().values(), *colony.observation().values(), colony.newest_frames):
        assert not any(np.shares_memory(values, kept) for kept in vars(colony).values() if isinstance(kept, np.ndarray))
    colony.close()
