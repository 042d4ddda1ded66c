"""A saved and restored environment goes on as the first would have: flights, contacts, drawn arenas, noise."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Episode, Rays, Sonar
from apex_bat.simulation.vector import EchoFlightVector
from apex_bat.storage import State, read_arrays, write_arrays

BATS = 12
FEW = Rays(num_azimuth=12, num_elevation=3, num_clearance=60)


def make(bats: int = BATS, caster: str = "embree", condition: str = "memory") -> EchoFlightVector:
    """Bats that touch walls and fly on, in drawn arenas, with every kind of noise."""
    rays = Rays(num_azimuth=12, num_elevation=3, num_clearance=60, caster="pybullet") if caster == "pybullet" else FEW
    return EchoFlightVector(
        bats, "corridor:0-2", condition, body=Body(heading_noise_deg=2.0, speed_noise=0.05), rays=rays,
        sonar=Sonar(rendering="exact", receiver_noise_db=30.0, level_jitter_db=1.0),
        episode=Episode(max_damage=30, max_idle=500, training_steps=50), autoreset_mode=AutoresetMode.NEXT_STEP,
    )  # fmt: skip


def actions(steps: int, seed: int) -> NDArray[np.int64]:
    return np.random.default_rng(seed).choice(3, size=(steps, BATS), p=(0.9, 0.05, 0.05))


def through_a_file(state: State, path: Path) -> State:
    write_arrays(path, "state", {"values": state.values}, state.arrays)
    header, arrays = read_arrays(path, "state")
    return State(header["values"], arrays)


@pytest.mark.parametrize(("caster", "condition"), [("embree", "memory"), ("pybullet", "onset")])
def test_restored_environment_goes_on_to_the_bit(caster: str, condition: str, tmp_path: Path) -> None:
    one, other = make(caster=caster, condition=condition), make(caster=caster, condition=condition)
    one.reset(seed=3)
    for row in actions(30, 0):
        before, *_ = one.step(row)
    observation = other.restore(through_a_file(one.state(), tmp_path / "state.npz"))
    for name, values in before.items():
        np.testing.assert_array_equal(values, observation[name], err_msg=name)
    num_contacts = num_ends = 0
    for row in actions(60, 1):
        ours, theirs = one.step(row), other.step(row)
        for left, right in ((ours[0], theirs[0]), (ours[4], theirs[4])):
            assert left.keys() == right.keys()
            for name, values in left.items():
                np.testing.assert_array_equal(values, right[name], err_msg=name)
        for left_array, right_array in zip(ours[1:4], theirs[1:4], strict=True):
            np.testing.assert_array_equal(left_array, right_array)
        num_contacts += int(ours[4]["contact"].sum())
        num_ends += int((ours[2] | ours[3]).sum())
    assert num_contacts > 10, "the test means something only where walls are touched"
    assert num_ends > 5, "and arenas are drawn"
    assert len(set(one.colony.arena_index.tolist())) > 1
    one.close()
    other.close()


def test_restoring_shares_nothing_with_the_state(tmp_path: Path) -> None:
    env = make()
    env.reset(seed=1)
    state = env.state()
    kept = through_a_file(state, tmp_path / "state.npz")
    for row in actions(5, 0):
        env.step(row)
    for name, values in kept.arrays.items():
        np.testing.assert_array_equal(values, state.arrays[name], err_msg=name)
    assert json.dumps(state.values, sort_keys=True) == json.dumps(kept.values, sort_keys=True)
    env.close()


def test_state_of_other_bats_is_refused() -> None:
    env, fewer = make(), make(bats=BATS - 1)
    with pytest.raises(ValueError, match="call reset before state"):
        env.state()
    fewer.reset(seed=0)
    with pytest.raises(ValueError, match="the state is of other bats"):
        env.restore(fewer.state())
    env.close()
    fewer.close()
