"""The single environment: Gymnasium's contract."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import apex_bat.simulation
from apex_bat.config.settings import Rays
from apex_bat.simulation.env import EchoFlight
from apex_bat.simulation.registration import ENVIRONMENT
from apex_bat.simulation.vector import EchoFlightVector

FEW = Rays(num_azimuth=20, num_elevation=4, num_clearance=90)


@pytest.mark.parametrize("arena", ["simple", "circle"])
@pytest.mark.parametrize("condition", ["memory", "no_memory", "onset"])
def test_environment_passes_gymnasiums_checker(arena: str, condition: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    env = gymnasium.make(ENVIRONMENT, arena=arena, condition=condition, rays=FEW)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # infinite bounds of the echoes, and no display
        check_env(env.unwrapped)
    env.close()


def test_environment_is_registered_on_import_and_by_module_name() -> None:
    assert apex_bat.simulation.__name__ in f"{apex_bat.simulation.__name__}:{ENVIRONMENT}"
    env = gymnasium.make(f"apex_bat.simulation:{ENVIRONMENT}", rays=FEW)
    assert isinstance(env.unwrapped, EchoFlight)
    env.close()


def test_single_flight_equals_that_of_one_bat_in_the_vector_environment() -> None:
    env, vector = EchoFlight(rays=FEW), EchoFlightVector(1, rays=FEW)
    one, many = env.reset(seed=4)[0], vector.reset(seed=4)[0]
    for action in (0, 1, 1, 0, 2):
        np.testing.assert_array_equal(one["echoes"], many["echoes"][0])
        np.testing.assert_array_equal(one["actions"], many["actions"][0])
        one, reward, *_, info = env.step(np.int64(action))
        many, rewards, *_, infos = vector.step(np.array([action]))
        assert reward == rewards[0]
        assert info["x_m"] == infos["x_m"][0]
    env.close()
    vector.close()


def test_start_pose_may_be_given() -> None:
    env = EchoFlight(rays=FEW)
    _, info = env.reset(seed=0, options={"pose": (3.811, 0.5, 1.0)})
    assert (info["x_m"], info["y_m"], info["heading_rad"]) == (3.811, 0.5, 1.0)
    with pytest.raises(ValueError, match="pose"):
        env.reset(options={"pose": (1.0, 2.0)})
    env.close()


def test_info_holds_plain_numbers_and_names_the_end() -> None:
    env = EchoFlight(rays=FEW, evaluation=True)
    _, info = env.reset(seed=0, options={"pose": (4.0, 0.0, 0.0)})
    assert {type(value) for value in info.values()} <= {float, int, bool, str}
    for _ in range(3):
        _, _, terminated, truncated, info = env.step(np.int64(0))
    assert (terminated, truncated, info["end"], info["contact"]) == (True, False, "contact", True)
    env.close()


def test_picture_is_an_image_and_there_is_none_without_the_mode() -> None:
    for mode, shape in (("rgb_array", (480, 640, 3)), (None, None)):
        env = EchoFlight(rays=FEW, render_mode=mode)
        env.reset(seed=0)
        picture = env.render()
        assert (None if picture is None else picture.shape) == shape
        env.close()


def test_action_that_does_not_exist_is_refused() -> None:
    env = EchoFlight(rays=FEW)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="it must be 0"):
        env.step(np.int64(3))
    env.close()


def test_unknown_render_mode_is_refused() -> None:
    with pytest.raises(ValueError, match="render_mode is 'ansi'"):
        EchoFlight(render_mode="ansi")


def test_window_without_a_display_is_said_aloud(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.warns(RuntimeWarning, match="no window"):
        EchoFlight(rays=FEW, render_mode="human").close()


def test_docstring_tells_every_key_of_info() -> None:
    env = EchoFlight(rays=FEW)
    _, info = env.reset(seed=0)
    missing = [key for key in info if f"`{key}`" not in str(EchoFlight.__doc__) and key != "end"]
    assert not missing
    env.close()
