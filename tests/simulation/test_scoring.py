"""Reward and ends against equation 3.2.2, written out case by case."""

import numpy as np

from apex_bat.config.settings import Episode
from apex_bat.simulation.scoring import (
    CONTACT,
    DAMAGE,
    ENDS,
    IDLE,
    ON,
    TIME,
    count_damage,
    count_idle,
    judge,
    score,
)

EPISODE = Episode()


def test_reward_follows_equation_3_2_2() -> None:
    clearance_m = np.array([0.5, 0.5, 0.5, 0.3, 0.3, 0.4, 0.4])
    actions = np.array([0, 1, 2, 0, 1, 0, 2])
    np.testing.assert_array_equal(score(clearance_m, actions, EPISODE).total, [0.05, 0, 0, -0.005, -0.005, 0, 0])


def test_reward_terms_are_told_apart() -> None:
    rewards = score(np.array([0.5, 0.3]), np.array([0, 0]), EPISODE)
    np.testing.assert_array_equal(rewards.straight, [0.05, 0.0])
    np.testing.assert_array_equal(rewards.near, [0.0, -0.005])


def test_damage_counts_near_steps_and_never_heals() -> None:
    damage = np.array([2])
    for clearance_m, expected in ((0.39, 3), (0.4, 3), (1.0, 3), (0.1, 4)):
        damage = count_damage(damage, np.array([clearance_m]), EPISODE)
        assert damage[0] == expected


def test_idleness_grows_on_punishment_and_ends_on_reward() -> None:
    idle = np.array([0])
    for reward, expected in ((-0.005, 1), (0.0, 1), (-0.005, 2), (0.05, 0)):
        idle = count_idle(idle, np.array([reward]))
        assert idle[0] == expected


def ends(steps: int, damage: int, idle: int, contact: bool, evaluation: bool) -> int:
    counters = np.array([steps]), np.array([damage]), np.array([idle])
    return int(judge(*counters, np.array([contact]), EPISODE, evaluation)[0])


def test_training_ends_by_the_fourth_damage_the_eleventh_idle_step_or_after_300_steps() -> None:
    assert ends(10, 3, 10, True, False) == ON
    assert ends(10, 4, 0, False, False) == DAMAGE
    assert ends(10, 0, 11, False, False) == IDLE
    assert ends(299, 0, 0, False, False) == ON
    assert ends(300, 0, 0, False, False) == TIME


def test_evaluation_ends_by_contact_or_after_1000_steps_only() -> None:
    assert ends(999, 99, 99, False, True) == ON
    assert ends(999, 0, 0, True, True) == CONTACT
    assert ends(1000, 0, 0, False, True) == TIME


def test_termination_in_the_last_step_is_no_truncation() -> None:
    assert ends(300, 4, 0, False, False) == DAMAGE
    assert ends(1000, 0, 0, True, True) == CONTACT


def test_ends_have_the_names_of_their_numbers() -> None:
    assert [str(ENDS[k]) for k in (ON, DAMAGE, IDLE, CONTACT, TIME)] == ["", "damage", "idle", "contact", "time"]
