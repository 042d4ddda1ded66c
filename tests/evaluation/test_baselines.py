"""Baselines: each does what it says, through the code that the network flies by."""

import numpy as np
import pytest

from apex_bat.config import ConfigError, load
from apex_bat.evaluation.baselines import BASELINES, LevelDifference, Random, level_difference_db, make_baseline
from apex_bat.evaluation.flights import Sighted, fly
from apex_bat.evaluation.oracle import Oracle
from apex_bat.experience import States

CONFIG = load(None, ["episode.evaluation_steps=40", "sonar.rendering=exact"])


def states(left: float, right: float) -> States:
    """Two equal states whose newest frame is so loud in each ear; the older frames are loud on the other side."""
    echoes = np.zeros((2, 6, 24), np.float32)
    echoes[:, -2, 4], echoes[:, -1, 4] = left, right
    echoes[:, 0, 4], echoes[:, 1, 4] = right, left
    return States(echoes, np.zeros((2, 3), np.uint8))


def test_ild_turns_away_from_the_louder_ear_and_flies_straight_between() -> None:
    pilot = LevelDifference()
    assert pilot(states(0.2, 0.1)).q.argmax(axis=1).tolist() == [2, 2]
    assert pilot(states(0.1, 0.2)).q.argmax(axis=1).tolist() == [1, 1]
    assert pilot(states(0.1, 0.1)).q.argmax(axis=1).tolist() == [0, 0]
    assert pilot(states(0.0, 0.0)).q.argmax(axis=1).tolist() == [0, 0]


def test_level_difference_undoes_the_compression_of_the_cochlea() -> None:
    # a pressure 10 times as great is 20 dB more, and 10^0.4 times the cochlea's output
    assert level_difference_db(states(0.1 * 10**0.4, 0.1)) == pytest.approx([20.0, 20.0], abs=1e-3)


def test_far_echoes_do_not_count_for_the_ild_pilot() -> None:
    echoes = np.zeros((1, 6, 24), np.float32)
    echoes[0, -2, 15] = 1.0
    assert level_difference_db(States(echoes, np.zeros((1, 3), np.uint8))) == pytest.approx([0.0])


def test_random_draws_all_actions_and_the_same_ones_from_the_same_seed() -> None:
    many = States(np.zeros((300, 6, 24), np.float32), np.zeros((300, 3), np.uint8))
    first = Random(5)(many).q.argmax(axis=1)
    counts = np.bincount(first, minlength=3)
    assert counts.min() > 60
    np.testing.assert_array_equal(first, Random(5)(many).q.argmax(axis=1))


def test_all_baselines_fly_the_same_starts() -> None:
    starts = []
    for name in BASELINES:
        records, _ = fly(make_baseline(name, CONFIG), CONFIG, "simple", num_flights=2, seed=3)
        starts.append([record.start for record in records])
    assert all(each == starts[0] for each in starts)


@pytest.mark.parametrize("arena", ["simple", "narrow", "circle"])
def test_the_oracle_stays_clear_where_straight_on_does_not(arena: str) -> None:
    records, _ = fly(make_baseline("oracle", CONFIG), CONFIG, arena, num_flights=4, seed=20_200)
    straight, _ = fly(make_baseline("straight", CONFIG), CONFIG, arena, num_flights=4, seed=20_200)
    assert all(record.completed for record in records)
    assert not any(record.completed for record in straight)
    assert min(record.progress_m for record in records) > 0.4 * 40 * 0.15, "it goes along the corridor"


@pytest.mark.slow
@pytest.mark.parametrize("arena", ["simple", "narrow", "circle"])
def test_the_oracle_completes_every_flight_of_the_thesiss_length(arena: str) -> None:
    config = load(None, [])
    records, _ = fly(make_baseline("oracle", config), config, arena, num_flights=15, seed=config.evaluation.start_seed)
    assert [record.completed for record in records] == [True] * 15


def test_only_the_oracle_is_shown_the_world() -> None:
    assert [name for name in BASELINES if isinstance(make_baseline(name, CONFIG), Sighted)] == ["oracle"]
    with pytest.raises(RuntimeError, match="must look"):
        Oracle()(states(0.1, 0.1))


def test_an_unknown_baseline_is_refused_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match="random, straight, ild, oracle"):
        make_baseline("best", CONFIG)
