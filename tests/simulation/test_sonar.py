"""The whole ear: test vectors, references written from the equations, and the effect of every setting."""

from __future__ import annotations

import doctest
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

from apex_bat.config import settings
from apex_bat.simulation import Sonar
from apex_bat.simulation import sonar as sonar_module

ONE: dict[str, Any] = {"azimuth_rad": [0.0], "elevation_rad": [0.0], "range_m": [1.0]}
AZIMUTH, ELEVATION = (
    grid.ravel() for grid in np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 100), np.linspace(0.0, np.pi / 6, 10))
)


def corridor_ranges_m(generator: np.random.Generator) -> np.ndarray:
    """Returns the ranges (1000,) of a bat between two walls 1.43 m apart and 1 m high, before a third."""
    offset_m, heading_rad = generator.uniform(-0.3, 0.3, 2)
    bearing = AZIMUTH + heading_rad
    with np.errstate(divide="ignore"):
        side_m = (0.715 - offset_m * np.sign(np.sin(bearing))) / np.abs(np.sin(bearing))
        end_m = np.where(np.cos(bearing) > 0.0, generator.uniform(1.0, 4.0) / np.cos(bearing), np.inf)
    ahead_m = np.minimum(side_m, end_m)
    return np.where(ahead_m * np.tan(ELEVATION) < 0.6, ahead_m / np.cos(ELEVATION), np.inf)


def reference_frame(level_db: np.ndarray, range_m: np.ndarray, rate_hz: float) -> np.ndarray:
    """Returns the frame (2, 24) of the thesis's chain in float64, at any sample rate, step by step."""
    num_samples, num_call, num_ramp = round(0.024 * rate_hz), int(0.0025 * rate_hz), round(31 * rate_hz / 125_000)
    call = np.sin(2.0 * np.pi * 40_000.0 * np.arange(num_call) / rate_hz)
    ramp = 0.5 * (1.0 - np.cos(np.pi * np.arange(num_ramp) / num_ramp))
    call[:num_ramp] *= ramp
    call[-num_ramp:] *= ramp[::-1]
    width_hz, loss = 24.7 + 40_000.0 / 9.265, 10.0**-0.075  # Hohmann's pole, -3 dB at half the width by four filters
    half = (1.0 - loss * np.cos(np.pi * width_hz / rate_hz)) / (1.0 - loss)
    pole = (half - np.sqrt(half**2 - 1.0)) * np.exp(2j * np.pi * 40_000.0 / rate_hz)
    frame = np.zeros((2, 24))
    for ear in range(2):
        taps = np.zeros(num_samples)
        for level, reach in zip(level_db[ear], range_m, strict=True):
            if level >= 20.0 and round(2.0 * reach / 343.0 * rate_hz) < num_samples:
                taps[round(2.0 * reach / 343.0 * rate_hz)] += 2e-5 * 10.0 ** (level / 20.0)
        motion = signal.fftconvolve(taps, call)[:num_samples].astype(np.complex128)
        for _ in range(4):
            motion = signal.lfilter([1.0], [1.0, -pole], motion)
        motion = 2.0 * (1.0 - abs(pole)) ** 4 * motion
        compressed = np.maximum(motion.real, 0.0) ** 0.4
        envelope = signal.lfilter(*signal.butter(2, 1000.0, fs=rate_hz), compressed)
        frame[ear] = np.maximum(envelope, 0.0).reshape(24, -1).mean(axis=1)
    return frame


def test_examples_of_the_module_are_true() -> None:
    failed, attempted = doctest.testmod(sonar_module)
    assert failed == 0
    assert attempted > 0


def test_vector_1_one_reflector_at_1_m() -> None:
    echo = Sonar(directivity="omni").hear(**ONE)
    assert echo.level_db[0, 0] == pytest.approx(57.364, abs=5e-4)
    np.testing.assert_allclose(echo.frame[0, 5:10], [0.00013, 0.05643, 0.07346, 0.04689, 0.00003], atol=1e-5)
    assert np.delete(echo.frame[0], range(5, 10)).max() < 2e-5


def test_vector_2_three_reflectors() -> None:
    echo = Sonar().hear(np.radians([0.0, 30.0, -45.0]), np.radians([0.0, 10.0, 20.0]), [0.8, 1.5, 2.2])
    np.testing.assert_allclose(echo.level_db, [[58.723, 47.648, 14.483], [58.723, 32.395, 34.074]], atol=5.1e-4)
    assert (echo.arrivals[0] == 0.0).tolist() == [[False, False, True]]
    left = [0.00247, 0.07101, 0.07809, 0.03678, 0.00056, 0.03982, 0.04691, 0.02584, 0.00001]
    right = [*left[:4], 0.00029, 0.01972, 0.02324, 0.01280, 0.00006, 0.01950, 0.02513, 0.01584, 0.00001]
    for heard, expected in zip(echo.frame, (left, right), strict=True):
        np.testing.assert_allclose(heard[4 : 4 + len(expected)], expected, atol=1e-5)
        assert np.delete(heard, range(4, 4 + len(expected))).max() < 1e-5


@pytest.mark.parametrize("level_db", [20.0, 40.0, 60.0])
def test_single_echo_has_its_greatest_value_by_its_level(level_db: float) -> None:
    call_level_db = np.float64(level_db + 40.0 + 2.0 * 1.318 + 1e-6)  # at 1 m; numpy's numbers are numbers too
    frame = Sonar(directivity="omni", call_level_db=call_level_db).hear(**ONE).frame
    assert frame.max() == pytest.approx(0.01315 * 10.0 ** (0.02 * (level_db - 20.0)), rel=0.03)


def test_thesis_rendering_is_the_chain_of_the_equations() -> None:
    generator = np.random.default_rng(14)
    sonar = Sonar()
    listener = sonar.listener(AZIMUTH, ELEVATION)
    for _ in range(3):
        range_m = corridor_ranges_m(generator)
        echo = sonar.hear(AZIMUTH, ELEVATION, range_m)
        expected = reference_frame(echo.level_db, range_m, 125_000.0)
        for frame in (echo.frame, listener.frames(range_m[None])[0]):
            np.testing.assert_allclose(frame, expected, rtol=1e-4, atol=1e-6)


def test_exact_rendering_is_within_5_percent_of_the_chain_at_2_mhz() -> None:
    generator = np.random.default_rng(15)
    sonar = Sonar(rendering="exact")
    for _ in range(6):
        range_m = corridor_ranges_m(generator)
        echo = sonar.hear(AZIMUTH, ELEVATION, range_m)
        expected = reference_frame(echo.level_db, range_m, 2_000_000.0)
        assert np.linalg.norm(echo.frame - expected) < 0.03 * np.linalg.norm(expected)
        assert np.abs(echo.frame - expected).max() < 0.05 * expected.max()


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
def test_mirrored_scenes_swap_the_ears_to_the_bit(rendering: str) -> None:
    sonar, range_m = Sonar(rendering=rendering, ear_separation_m=0.04), corridor_ranges_m(np.random.default_rng(16))
    echo, mirrored = (sonar.hear(side * AZIMUTH, ELEVATION, range_m) for side in (1.0, -1.0))
    for stage in ("level_db", "envelope", "frame"):
        np.testing.assert_array_equal(getattr(echo, stage), getattr(mirrored, stage)[::-1])


def test_misses_are_silent() -> None:
    echo = Sonar().hear([0.0, 0.1], [0.0, 0.0], [np.inf, 1.0])
    alone = Sonar().hear([0.1], [0.0], [1.0])
    assert np.isneginf(echo.level_db[:, 0]).all()
    np.testing.assert_array_equal(echo.frame, alone.frame)


def loudest(**changes: Any) -> float:
    pressure_pa = Sonar(directivity="omni", **changes).hear(**ONE).pressure_pa
    assert pressure_pa is not None
    return float(np.abs(pressure_pa[0]).max())


def test_twenty_decibels_more_call_are_ten_times_the_pressure() -> None:
    assert loudest(call_level_db=120) == pytest.approx(10.0 * loudest(), rel=1e-12)


def test_absorption_can_come_from_temperature_and_humidity() -> None:
    iso = loudest(absorption_db_m=None, temperature_c=20.0, humidity_percent=50.0)
    assert 20.0 * np.log10(iso / loudest()) == pytest.approx(-2.0 * (1.3182 - 1.318), abs=1e-4)
    assert loudest(absorption_db_m=None, temperature_c=20.0, humidity_percent=10.0) > iso


def test_slower_sound_is_heard_later() -> None:
    first = [
        np.flatnonzero(Sonar(speed_of_sound_m_s=speed).hear(**ONE).impulse_response[0])[0] for speed in (343.0, 171.5)
    ]
    assert first == [729, 1458]


def test_floor_decides_what_is_heard() -> None:
    level_db = float(Sonar(directivity="omni").hear(**ONE).level_db[0, 0])
    assert Sonar(directivity="omni", floor_db=level_db - 0.01).hear(**ONE).frame.any()
    assert not Sonar(directivity="omni", floor_db=level_db + 0.01).hear(**ONE).frame.any()


def test_frequency_moves_call_and_channel_together() -> None:
    echo = Sonar(directivity="omni", frequency_hz=30_000.0).hear(**ONE)
    assert echo.pressure_pa is not None
    spectrum = np.abs(np.fft.rfft(echo.pressure_pa[0]))
    assert np.argmax(spectrum) * 125_000 / 3000 == pytest.approx(30_000.0, abs=50.0)
    assert echo.frame.max() == pytest.approx(Sonar(directivity="omni").hear(**ONE).frame.max(), rel=0.03)


def test_longer_call_and_shorter_ramps_give_more_echo() -> None:
    plain = Sonar().hear(**ONE).frame.sum()
    assert Sonar(call_duration_s=0.005).hear(**ONE).frame.sum() > 1.5 * plain
    assert Sonar(call_ramp_samples=0).hear(**ONE).frame.sum() > plain


def test_sweep_leaves_less_in_the_channel_of_its_centre() -> None:
    assert Sonar(sweep_hz=20_000.0).hear(**ONE).frame.sum() < 0.9 * Sonar().hear(**ONE).frame.sum()


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
def test_two_echoes_out_of_phase_cancel_as_pressures_and_add_as_energies(rendering: str) -> None:
    farther_m = 3.5 * 343.0 / 40_000.0 / 2.0  # 3.5 waves there and back, which 11 samples of 8 us nearly are
    pair: dict[str, Any] = {"azimuth_rad": [0.0] * 2, "elevation_rad": [0.0] * 2, "range_m": [1.0, 1.0 + farther_m]}
    single = Sonar(rendering=rendering).hear(**ONE).frame.max()
    coherent = Sonar(rendering=rendering).hear(**pair).frame.max()
    incoherent = Sonar(rendering=rendering, summation="incoherent").hear(**pair).frame.max()
    assert coherent < 0.6 * single
    assert incoherent == pytest.approx(2.0**0.2 * single, rel=0.03)


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
def test_energies_add_to_the_mean_over_random_phases(rendering: str) -> None:
    generator = np.random.default_rng(17)
    range_m = generator.uniform(1.0, 1.5, 30)
    scene = (generator.uniform(-0.5, 0.5, 30), np.zeros(30), range_m)
    random_phase = Sonar(rendering=rendering, summation="random_phase")
    power = np.mean([np.square(random_phase.hear(*scene, generator).rectified).sum() for _ in range(150)])
    energy = np.square(Sonar(rendering=rendering, summation="incoherent").hear(*scene).rectified).sum()
    assert power == pytest.approx(energy, rel=0.15)


def test_jitter_changes_levels_by_its_deviation_and_both_ears_alike() -> None:
    scene = (np.zeros(4000), np.zeros(4000), np.ones(4000))
    jittered = Sonar(level_jitter_db=3.0).hear(*scene, np.random.default_rng(18)).level_db
    change_db = jittered - Sonar().hear(*scene).level_db
    np.testing.assert_array_equal(change_db[0], change_db[1])
    assert change_db[0].std() == pytest.approx(3.0, rel=0.05)
    assert change_db[0].mean() == pytest.approx(0.0, abs=0.2)


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
def test_noise_has_its_level_in_the_channel(rendering: str) -> None:
    sonar = Sonar(rendering=rendering, receiver_noise_db=45.0)
    far = np.full((40, 1), np.inf)
    motion = sonar.hear(np.zeros((40, 1)), np.zeros((40, 1)), far, np.random.default_rng(19)).gammatone
    power = np.square(np.abs(motion)).mean() * (2.0 if rendering == "thesis" else 1.0)  # of a tone: p^2 / 2, and p^2
    assert 10.0 * np.log10(power / 4e-10) == pytest.approx(45.0, abs=0.3)


def test_noise_is_in_the_sound_and_the_cochleagram_too() -> None:
    for rendering in ("thesis", "exact"):
        quiet, noisy = (
            Sonar(rendering=rendering, receiver_noise_db=noise_db).hear(**ONE, generator=np.random.default_rng(20))
            for noise_db in (None, 50.0)
        )
        assert noisy.cochleagram.mean() > 1.5 * quiet.cochleagram.mean()
    assert Sonar().hear(**ONE).noise_pa is None


def test_separated_ears_hear_the_side_at_different_times() -> None:
    taps = Sonar(directivity="omni", ear_separation_m=0.2).hear([np.pi / 2], [0.0], [1.0]).impulse_response
    first = [int(np.flatnonzero(ear)[0]) for ear in taps]
    assert first == [round(1.9 / 343.0 * 125_000.0), round(2.1 / 343.0 * 125_000.0)]


def test_directivity_settings_reach_the_ear(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", azimuth_rad=[-2.0, 2.0], elevation_rad=[-1.0, 1.0], level_db=np.full((2, 2, 2), -7.0))
    table = Sonar(directivity="table", directivity_table=str(tmp_path / "t.npz"))
    kinds = [Sonar(), Sonar(directivity="omni"), Sonar(directivity="piston"), table]
    kinds += [Sonar(directivity="piston", piston_radius_m=0.008), Sonar(directivity="piston", piston_angle_deg=10.0)]
    levels = {round(float(kind.hear([0.3], [0.1], [1.0]).level_db[0, 0]), 6) for kind in kinds}
    assert len(levels) == len(kinds)


def test_changes_start_from_the_given_settings() -> None:
    base = settings.Sonar(call_level_db=110.0)
    assert Sonar(base, rendering="exact").settings == settings.Sonar(call_level_db=110.0, rendering="exact")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"loudness": 3}, "loudness"),
        ({"rendering": "analogue"}, "analogue"),
        ({"absorption_db_m": None}, "temperature_c"),
        ({"call_ramp_samples": 200}, "ramps"),
        ({"sweep_hz": 90_000.0}, "sweep"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        Sonar(**changes)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "reach", "named"),
    [
        ([0.0, 0.0], [0.0], [1.0], "elevation_rad"),
        ([0.0], [0.0], [1.0, 2.0], "range_m has shape"),
        ([np.nan], [0.0], [1.0], "azimuth_rad must be finite"),
        ([0.0], [np.inf], [1.0], "elevation_rad must be finite"),
        ([0.0], [0.0], [np.nan], "range_m has NaN"),
        ([0.0], [0.0], [-1.0], "range_m must be greater than 0"),
        ([[[0.0]]], [[[0.0]]], [[[1.0]]], r"\(bats, points\)"),
        (0.0, 0.0, 1.0, r"\(bats, points\)"),
    ],
)
def test_wrong_points_are_refused_by_name(azimuth: Any, elevation: Any, reach: Any, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        Sonar().hear(azimuth, elevation, reach)


def test_random_settings_need_a_generator() -> None:
    with pytest.raises(ValueError, match="generator"):
        Sonar(summation="random_phase").hear(**ONE)
