"""The vector environment: Gymnasium's contract, independence of neighbours, conditions, ends."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Episode, Rays
from apex_bat.simulation.arenas import ArenaError, load_arenas
from apex_bat.simulation.vector import EchoFlightVector

FEW = Rays(num_azimuth=20, num_elevation=4, num_clearance=90)
"""Fewer rays, where the number does not matter."""
AT_WALL = np.array([[4.0, 0.0, 0.0], [3.811, 0.0, np.pi / 2]])
"""In simple: one bat that flies into the eastern wall, one that has a free corridor ahead."""


def fly(env: EchoFlightVector, seed: int, actions: NDArray[np.int64]) -> list[dict[str, Any]]:
    observation, _ = env.reset(seed=seed)
    flight = [{**observation, "poses": env.poses.copy()}]
    for row in actions:
        observation, reward, terminated, truncated, info = env.step(row)
        flight.append(
            {
                **observation,
                "poses": env.poses.copy(),
                "reward": reward,
                "terminated": terminated,
                "truncated": truncated,
            }
        )
        flight[-1]["progress"] = info["progress_m"]
    env.close()
    return flight


@pytest.mark.parametrize("arena", ["simple", "corridor:0-2"])
def test_flight_is_the_same_to_the_bit_alone_and_among_31_others(arena: str) -> None:
    noise = Body(heading_noise_deg=2.0, speed_noise=0.05)
    actions = np.random.default_rng(0).choice(3, size=(12, 32), p=(0.5, 0.25, 0.25))
    together = fly(EchoFlightVector(32, arena, body=noise, rays=FEW), 100, actions)
    for bat in (0, 13, 31):
        alone = fly(EchoFlightVector(1, arena, body=noise, rays=FEW), 100 + bat, actions[:, bat : bat + 1])
        for one, many in zip(alone, together, strict=True):
            for key, value in one.items():
                np.testing.assert_array_equal(value[0], many[key][bat], err_msg=key)


def test_flight_is_the_same_to_the_bit_with_all_the_rays() -> None:
    actions = np.random.default_rng(0).choice(3, size=(4, 16))
    together = fly(EchoFlightVector(16), 5, actions)
    alone = fly(EchoFlightVector(1), 5 + 9, actions[:, 9:10])
    for one, many in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one["echoes"][0], many["echoes"][9])


def test_observation_lies_in_its_space_and_is_a_new_array_each_time() -> None:
    env = EchoFlightVector(3, rays=FEW)
    first, _ = env.reset(seed=1)
    kept = {key: value.copy() for key, value in first.items()}
    second = env.step(np.array([0, 1, 2]))[0]
    assert env.observation_space.contains(first)
    assert env.observation_space.contains(second)
    for key, value in kept.items():
        np.testing.assert_array_equal(first[key], value)
    env.close()


def test_echo_rows_move_up_and_the_newest_come_last() -> None:
    env = EchoFlightVector(2, rays=FEW)
    echoes, frames = [env.reset(seed=3)[0]["echoes"]], [env.newest_frames]
    for _ in range(3):
        echoes.append(env.step(np.zeros(2, np.int64))[0]["echoes"])
        frames.append(env.newest_frames)
    assert not echoes[0][:, :4].any(), "before the first step there was silence"
    np.testing.assert_array_equal(echoes[3], np.concatenate(frames[1:], axis=1))
    assert np.abs(frames[3] - frames[2]).max() > 0.0
    env.close()


def test_actions_are_remembered_oldest_first() -> None:
    env = EchoFlightVector(1, rays=FEW)
    env.reset(seed=3, options={"poses": AT_WALL[1:]})
    remembered = [env.step(np.array([action]))[0]["actions"][0].tolist() for action in (1, 2, 0, 1)]
    assert remembered == [[0, 0, 1], [0, 1, 2], [1, 2, 0], [2, 0, 1]]
    env.close()


def test_conditions_blank_what_they_should() -> None:
    echoes = {}
    for condition in ("memory", "no_memory", "onset"):
        env = EchoFlightVector(2, condition=condition, rays=FEW)
        env.reset(seed=3)
        for _ in range(3):
            echoes[condition] = env.step(np.zeros(2, np.int64))[0]["echoes"]
        env.close()
    assert not echoes["no_memory"][:, :4].any()
    np.testing.assert_array_equal(echoes["no_memory"][:, 4:], echoes["memory"][:, 4:])
    heard, onset = echoes["memory"], echoes["onset"]
    assert ((onset > 0).sum(axis=2) == (heard > 0.0131).any(axis=2)).all()
    np.testing.assert_array_equal(onset[onset > 0], heard[onset > 0])


def test_info_tells_pose_distance_and_reward_terms() -> None:
    env = EchoFlightVector(2, rays=FEW)
    env.reset(seed=0, options={"poses": AT_WALL})
    for _ in range(4):
        _, reward, _, _, info = env.step(np.zeros(2, np.int64))
    np.testing.assert_allclose([info["x_m"][1], info["y_m"][1], info["heading_rad"][1]], [3.811, 0.6, np.pi / 2])
    assert info["distance_m"][1] == pytest.approx(0.6)
    assert info["progress_m"][1] == pytest.approx(0.6)
    assert info["laps"][1] == pytest.approx(0.6 / 30.44, rel=1e-3)
    np.testing.assert_array_equal(info["reward_straight"] + info["reward_near"], reward)
    np.testing.assert_array_equal(reward, [-0.005, 0.05])
    np.testing.assert_array_equal(info["contact"], [True, False])
    assert info["distance_m"][0] == pytest.approx(4.35 - 4.0, abs=2e-3)
    assert info["clearance_m"][1] == pytest.approx(0.71, abs=0.02)
    env.close()


def test_a_spinning_bat_flies_but_makes_no_progress() -> None:
    env = EchoFlightVector(1, rays=FEW, evaluation=True)
    env.reset(seed=0, options={"poses": np.array([[3.811 + 0.477, 0.0, np.pi / 2]])})
    for _ in range(100):
        *_, info = env.step(np.ones(1, np.int64))
    assert info["distance_m"][0] == pytest.approx(15.0, abs=0.01)
    assert abs(info["progress_m"][0]) < 1e-6
    env.close()


def test_training_ends_by_damage_and_evaluation_by_contact() -> None:
    names = []
    for evaluation in (False, True):
        env = EchoFlightVector(1, rays=FEW, evaluation=evaluation)
        env.reset(seed=0, options={"poses": AT_WALL[:1]})
        for _ in range(8):
            _, _, terminated, truncated, info = env.step(np.zeros(1, np.int64))
            if terminated[0]:
                break
        assert not truncated[0]
        names.append((info["steps"][0], info["end"][0]))
        env.close()
    assert names == [(4, "damage"), (3, "contact")]


def test_time_limit_truncates_and_does_not_terminate() -> None:
    for evaluation in (False, True):
        env = EchoFlightVector(
            1, rays=FEW, episode=Episode(training_steps=3, evaluation_steps=3), evaluation=evaluation
        )
        env.reset(seed=0, options={"poses": AT_WALL[1:]})
        for expected in (False, False, True):
            _, _, terminated, truncated, info = env.step(np.zeros(1, np.int64))
            assert (bool(terminated[0]), bool(truncated[0])) == (False, expected)
        assert info["end"][0] == "time"
        env.close()


def short_env(mode: AutoresetMode) -> EchoFlightVector:
    env = EchoFlightVector(2, rays=FEW, episode=Episode(training_steps=6), autoreset_mode=mode)
    env.reset(seed=0, options={"poses": AT_WALL})
    return env


def test_next_step_autoreset_ignores_the_action_and_returns_the_first_observation() -> None:
    env = short_env(AutoresetMode.NEXT_STEP)
    for _ in range(4):
        _, _, terminated, _, _ = env.step(np.zeros(2, np.int64))
    np.testing.assert_array_equal(terminated, [True, False])
    observation, reward, terminated, truncated, info = env.step(np.ones(2, np.int64))
    assert (reward[0], bool(terminated[0]), bool(truncated[0]), info["steps"][0]) == (0.0, False, False, 0)
    assert not observation["echoes"][0, :4].any()
    assert not observation["actions"][0].any()
    assert info["steps"][1] == 5
    env.close()


def test_same_step_autoreset_hands_over_the_last_observation_and_info() -> None:
    env, other = short_env(AutoresetMode.SAME_STEP), short_env(AutoresetMode.DISABLED)
    for _ in range(4):
        observation, reward, terminated, _, info = env.step(np.zeros(2, np.int64))
        last, last_reward, _, _, last_info = other.step(np.zeros(2, np.int64))
    np.testing.assert_array_equal(terminated, [True, False])
    np.testing.assert_array_equal(reward, last_reward)
    np.testing.assert_array_equal(info["_final_obs"], [True, False])
    np.testing.assert_array_equal(info["final_obs"][0]["echoes"], last["echoes"][0])
    assert info["final_obs"][1] is None
    assert info["final_info"]["end"][0] == "damage"
    assert info["final_info"]["x_m"][0] == last_info["x_m"][0]
    assert info["steps"].tolist() == [0, 4]
    assert not observation["echoes"][0, :4].any()
    np.testing.assert_array_equal(observation["echoes"][1], last["echoes"][1])
    env.close()
    other.close()


def test_disabled_autoreset_wants_a_reset_of_those_that_ended() -> None:
    env = short_env(AutoresetMode.DISABLED)
    for _ in range(4):
        before = env.step(np.zeros(2, np.int64))[0]
    with pytest.raises(ValueError, match=r"the episodes of bats \[0\] have ended"):
        env.step(np.zeros(2, np.int64))
    observation, info = env.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(observation["echoes"][1], before["echoes"][1])
    assert info["steps"].tolist() == [0, 4]
    np.testing.assert_array_equal(info["_steps"], [True, False])
    env.step(np.zeros(2, np.int64))
    env.close()


def test_seeds_may_be_given_one_by_one_and_none_goes_on() -> None:
    env = EchoFlightVector(2, rays=FEW)
    env.reset(seed=[7, 9])
    first = env.poses.copy()
    env.reset(seed=[9, 7])
    np.testing.assert_array_equal(env.poses, first[::-1])
    env.reset()
    assert (env.poses != first[::-1]).any(axis=1).all()
    env.reset(seed=7)
    np.testing.assert_array_equal(env.poses[0], first[0])
    env.close()


def test_each_episode_draws_one_of_several_arenas() -> None:
    env = EchoFlightVector(4, load_arenas("simple,corridor:1-3"), rays=FEW)
    env.reset(seed=0)
    seen = {int(index) for _ in range(8) for index in env.reset()[1]["arena_index"]}
    assert seen == {0, 1, 2, 3}
    assert (env.clearance_m > 0.4 - 0.05).all()
    assert [arena.name for arena in env.arenas] == ["simple", "corridor:1", "corridor:2", "corridor:3"]
    env.close()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"condition": "deaf"}, "condition is 'deaf'; it must be one of memory, no_memory, onset"),
        ({"num_envs": 0}, "num_bats is 0"),
        ({"render_mode": "ansi"}, "render_mode is 'ansi'"),
        ({"autoreset_mode": "later"}, "later"),
    ],
)
def test_bad_argument_is_named(arguments: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        EchoFlightVector(**arguments)


def test_unknown_arena_is_named() -> None:
    with pytest.raises(ArenaError, match="nowhere: no such arena"):
        EchoFlightVector(1, "nowhere")


def test_bad_calls_are_refused() -> None:
    env = EchoFlightVector(2, rays=FEW)
    with pytest.raises(ValueError, match="call reset"):
        env.step(np.zeros(2, np.int64))
    with pytest.raises(ValueError, match="first reset must be of all"):
        env.reset(options={"reset_mask": np.array([True, False])})
    env.reset(seed=0)
    bad: list[NDArray[Any]] = [np.zeros(3, np.int64), np.zeros(2), np.array([0, 3]), np.array([-1, 0])]
    for actions in bad:
        with pytest.raises(ValueError, match="actions must be"):
            env.step(actions)
    for mask in (np.array([1, 0]), np.array([True]), np.array([False, False])):
        with pytest.raises(ValueError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})
    for poses in (np.zeros((1, 3)), np.full((2, 3), np.nan)):
        with pytest.raises(ValueError, match="poses"):
            env.reset(options={"poses": poses})
    with pytest.raises(ValueError, match="3 seeds were given for 2 bats"):
        env.reset(seed=[1, 2, 3])
    env.close()


def test_gymnasium_makes_the_vector_environment_and_its_wrappers_count_episodes() -> None:
    made = gymnasium.make_vec("apex_bat.simulation:apex_bat/EchoFlight-v0", num_envs=2, arena="circle", rays=FEW)
    assert isinstance(made.unwrapped, EchoFlightVector)
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(made)
    env.reset(seed=0)
    returns = []
    for _ in range(60):
        *_, info = env.step(np.zeros(2, np.int64))
        returns += list(info["episode"]["l"][info["_episode"]]) if "episode" in info else []
    assert returns
    assert min(returns) >= 4
    env.close()
