"""A bat in the mirror: what the learner takes for granted of the world when it swaps left and right."""

from __future__ import annotations

import msgspec
import numpy as np

from apex_bat.agent.mirror import mirror_batch, mirror_states
from apex_bat.experience import Batch, States
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.vector import EchoFlightVector

LEFT, RIGHT = 1, 2


def random_states(generator: np.random.Generator, size: int) -> States:
    return States(generator.random((size, 6, 24), np.float32), generator.integers(0, 3, (size, 3)).astype(np.uint8))


def mirrored_arena(arena: Arena) -> Arena:
    walls = tuple(wall._replace(y_m=-wall.y_m, yaw_rad=-wall.yaw_rad) for wall in arena.walls)
    return msgspec.structs.replace(arena, start=(arena.start[0], -arena.start[1]), walls=walls, centre_line=())


def test_ears_and_turns_are_swapped_and_calls_keep_their_order() -> None:
    echoes = np.zeros((1, 6, 24), np.float32)
    echoes[0, :, 0] = [1, 2, 3, 4, 5, 6]  # oldest left, oldest right, ..., newest right
    before = States(echoes, np.array([[0, LEFT, RIGHT]], np.uint8))
    after = mirror_states(before, np.array([True]))
    assert after.echoes[0, :, 0].tolist() == [2, 1, 4, 3, 6, 5]
    assert after.actions.tolist() == [[0, RIGHT, LEFT]]
    assert before.echoes[0, 0, 0] == 1, "what was given stays as it is"


def test_only_the_rows_asked_for_are_mirrored_and_twice_is_nothing() -> None:
    generator = np.random.default_rng(0)
    batch = Batch(
        np.arange(5), generator.random(5, np.float32), random_states(generator, 5),
        np.array([0, 1, 2, 1, 2], np.uint8), generator.random(5, np.float32), generator.random(5, np.float32),
        random_states(generator, 5),
    )  # fmt: skip
    rows = np.array([True, True, False, False, True])
    once = mirror_batch(batch, rows)
    assert once.actions.tolist() == [0, RIGHT, 2, 1, LEFT]
    for before, after in ((batch.states, once.states), (batch.next_states, once.next_states)):
        assert (before.echoes[~rows] == after.echoes[~rows]).all()
        assert (before.echoes[rows] != after.echoes[rows]).all()
    assert once.rewards is batch.rewards
    assert once.items is batch.items
    twice = mirror_batch(once, rows)
    for name in ("states", "next_states"):
        for a, b in zip(getattr(twice, name), getattr(batch, name), strict=True):
            np.testing.assert_array_equal(a, b)


def test_in_the_mirrored_arena_the_mirrored_bat_hears_and_earns_the_same() -> None:
    arena, bats = load_arena("narrow"), 8
    generator = np.random.default_rng(0)
    plain, mirrored = EchoFlightVector(bats, arena), EchoFlightVector(bats, mirrored_arena(arena))
    everyone = np.ones(bats, bool)
    try:
        plain.reset(seed=0)
        poses = plain.colony.poses.copy()
        seen, _ = plain.reset(seed=0, options={"poses": poses})
        other, _ = mirrored.reset(seed=0, options={"poses": poses * [1.0, -1.0, -1.0]})
        heard = []
        for _ in range(20):
            states = States(seen["echoes"], seen["actions"])
            image = mirror_states(states, everyone)
            heard.append(np.abs(image.echoes - other["echoes"]).max())
            np.testing.assert_array_equal(image.actions, other["actions"])
            actions = generator.integers(0, 3, bats)
            seen, rewards, ended, *_ = plain.step(actions)
            other, image_rewards, image_ended, *_ = mirrored.step(np.array([0, RIGHT, LEFT])[actions])
            np.testing.assert_allclose(rewards, image_rewards)
            np.testing.assert_array_equal(ended, image_ended)
            if ended.any():
                break
        assert len(heard) > 3
        assert max(heard) < 1e-3  # a reflector on the edge of a sample may fall to either side
    finally:
        plain.close()
        mirrored.close()
