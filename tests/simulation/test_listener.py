"""The fast ear against the slow one, and each bat's independence of its neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from apex_bat.simulation.listener import Listener
from apex_bat.simulation.sonar import Sonar

AZIMUTH, ELEVATION = (
    grid.ravel() for grid in np.meshgrid(np.linspace(-1.5, 1.5, 40), np.linspace(0.0, 0.5, 10), indexing="ij")
)
SETTINGS: list[dict[str, Any]] = [
    {},
    {"level_jitter_db": 3.0},
    {"summation": "random_phase"},
    {"summation": "incoherent"},
    {"receiver_noise_db": 35.0},
    {"summation": "incoherent", "receiver_noise_db": 35.0, "level_jitter_db": 1.0},
    {"summation": "random_phase", "receiver_noise_db": 35.0, "sweep_hz": 6000.0},
    {"ear_separation_m": 0.03},
    {"sweep_hz": -12_000.0},
    {"directivity": "piston", "frequency_hz": 50_000.0, "call_duration_s": 0.005, "floor_db": 40.0},
]


def ranges(num_bats: int) -> np.ndarray:
    """Returns the ranges (bats, points) of random points, every sixth of them a miss."""
    generator = np.random.default_rng(12)
    range_m = generator.uniform(0.3, 6.0, (num_bats, len(AZIMUTH))).astype(np.float32)
    range_m[generator.random(range_m.shape) < 1 / 6] = np.inf
    return range_m


def generators(first: int, num_bats: int) -> list[np.random.Generator]:
    return [np.random.default_rng(number) for number in range(first, first + num_bats)]


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
@pytest.mark.parametrize("changes", SETTINGS, ids=str)
def test_frames_are_those_of_hear(rendering: str, changes: dict[str, Any]) -> None:
    sonar, range_m = Sonar(rendering=rendering, **changes), ranges(3)
    frames = sonar.listener(AZIMUTH, ELEVATION).frames(range_m, generators(0, 3))
    for bat, generator in enumerate(generators(0, 3)):
        heard = sonar.hear(AZIMUTH, ELEVATION, range_m[bat], generator).frame
        np.testing.assert_allclose(frames[bat], heard, atol=1e-6)


@pytest.mark.parametrize("changes", SETTINGS[:7], ids=str)
@pytest.mark.parametrize("rendering", ["thesis", "exact"])
def test_a_bat_hears_the_same_bits_alone_and_among_31_others(rendering: str, changes: dict[str, Any]) -> None:
    listener, range_m = Sonar(rendering=rendering, **changes).listener(AZIMUTH, ELEVATION), ranges(32)
    together = listener.frames(range_m, generators(0, 32))
    for bat in (0, 1, 17, 31):
        alone = listener.frames(range_m[bat : bat + 1], generators(bat, 1))
        np.testing.assert_array_equal(alone[0], together[bat])


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
def test_mirrored_rays_swap_the_ears_to_the_bit(rendering: str) -> None:
    sonar, range_m = Sonar(rendering=rendering), ranges(4)
    frames = sonar.listener(AZIMUTH, ELEVATION).frames(range_m)
    mirrored = sonar.listener(-AZIMUTH, ELEVATION).frames(range_m)
    np.testing.assert_array_equal(frames, mirrored[:, ::-1])


def test_misses_alone_are_silence() -> None:
    for rendering in ("thesis", "exact"):
        frames = Sonar(rendering=rendering).listener(AZIMUTH, ELEVATION).frames(np.full((2, 400), np.inf, np.float32))
        np.testing.assert_allclose(frames, 0.0, atol=1e-7)


def test_no_bats_have_no_frames() -> None:
    assert listener().frames(ranges(0)).shape == (0, 2, 24)


def listener(**changes: Any) -> Listener:
    return Sonar(**changes).listener(AZIMUTH, ELEVATION)


def test_frames_are_float32() -> None:
    assert listener().frames(ranges(1)).dtype == np.float32


def test_wrong_number_of_rays_is_refused() -> None:
    with pytest.raises(ValueError, match="400 rays"):
        listener().frames(np.ones((2, 399), np.float32))


@pytest.mark.parametrize("wrong", [np.nan, -1.0, 0.0])
def test_impossible_range_is_refused(wrong: float) -> None:
    range_m = ranges(2)
    range_m[1, 5] = wrong
    with pytest.raises(ValueError, match="range_m"):
        listener().frames(range_m)


def test_random_settings_without_generators_are_refused() -> None:
    with pytest.raises(ValueError, match="generator"):
        listener(level_jitter_db=1.0).frames(ranges(2))


def test_one_generator_for_two_bats_is_refused() -> None:
    with pytest.raises(ValueError, match="1 generators were given for 2 bats"):
        listener(level_jitter_db=1.0).frames(ranges(2), generators(0, 1))
