"""The yardstick of the benchmark computes what the simulation computes."""

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from apex_bat.config.settings import Rays
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.env import EchoFlight
from apex_bat.simulation.sonar import Sonar

START = (4.288, 0.0, np.pi / 2)


@pytest.fixture
def yardstick(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2]))
    return importlib.import_module("benchmarks.obvious_environment")


def test_its_ear_hears_the_same(yardstick: ModuleType) -> None:
    obvious = yardstick.ObviousEnvironment(load_arena("simple"), START)
    range_m = obvious._ranges_m(obvious._ahead)
    azimuth_rad, elevation_rad = np.array(obvious._ahead).T
    expected = Sonar().hear(azimuth_rad, elevation_rad, range_m).frame
    frame = np.stack([obvious._hear(range_m, obvious._gain_db[ear]) for ear in range(2)])
    obvious.close()
    assert expected.max() > 0.1
    np.testing.assert_allclose(frame, expected, atol=2e-5)


def test_it_flies_the_same_way_past_the_same_walls(yardstick: ModuleType) -> None:
    obvious = yardstick.ObviousEnvironment(load_arena("simple"), START)
    env = EchoFlight("simple", rays=Rays(num_azimuth=20, num_elevation=4))
    env.reset(options={"pose": START})
    for action in (0, 1, 2, 1):
        _, clearance_m = obvious.step(action)
        _, _, _, _, info = env.step(np.int64(action))
        np.testing.assert_allclose(obvious._pose[:2], [info["x_m"], info["y_m"]], atol=1e-9)
        assert clearance_m == pytest.approx(info["clearance_m"], abs=0.005)
    obvious.close()
    env.close()
