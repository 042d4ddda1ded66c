"""Levels, absorption, call and impulse response against closed forms and naive twins."""

from __future__ import annotations

import numpy as np
import pytest

from apex_bat.config import settings
from apex_bat.simulation import acoustics

THESIS = settings.Sonar()
NO_CHANCE = acoustics.Chance(None, None, None)


@pytest.mark.parametrize(
    ("range_m", "level_db"),
    [(0.3, 80.1), (0.5, 70.7), (1.0, 57.364), (2.0, 42.7), (3.0, 33.0), (4.0, 25.4), (4.81, 20.0)],
)
def test_level_follows_equation_3_1_1(range_m: float, level_db: float) -> None:
    assert acoustics.level_db(THESIS, np.array([range_m]), np.zeros(1))[0] == pytest.approx(level_db, abs=0.051)


def test_a_miss_has_no_level() -> None:
    assert acoustics.level_db(THESIS, np.array([np.inf]), np.zeros(1))[0] == -np.inf


def test_call_level_raises_every_level() -> None:
    louder = settings.Sonar(call_level_db=120.0)
    range_m = np.array([0.7, 3.0])
    gain_db = acoustics.level_db(louder, range_m, np.zeros(2)) - acoustics.level_db(THESIS, range_m, np.zeros(2))
    np.testing.assert_allclose(gain_db, 20.0)


def test_twenty_decibels_are_ten_times_the_pressure() -> None:
    assert acoustics.pressure_pa(0.0) == 2e-5
    assert acoustics.pressure_pa(20.0) == pytest.approx(2e-4)


def test_absorption_at_40_khz_20_c_50_percent_is_the_thesis_value() -> None:
    assert acoustics.iso_absorption_db_m(40_000.0, 20.0, 50.0) == pytest.approx(1.3182, abs=5e-5)


@pytest.mark.parametrize(
    ("frequency_hz", "temperature_c", "humidity_percent", "absorption_db_km"),
    [
        (3981.07, 20.0, 70.0, 22.9),
        (3981.07, 10.0, 70.0, 32.8),
        (7943.28, 10.0, 70.0, 117.0),
        (7943.28, 15.0, 50.0, 129.0),
    ],
)
def test_absorption_agrees_with_the_table_of_iso_9613_2(
    frequency_hz: float, temperature_c: float, humidity_percent: float, absorption_db_km: float
) -> None:
    absorption = acoustics.iso_absorption_db_m(frequency_hz, temperature_c, humidity_percent)
    assert 1000.0 * absorption == pytest.approx(absorption_db_km, rel=0.005)


def test_absorption_setting_is_one_way_decibels_per_metre() -> None:
    thirsty = settings.Sonar(absorption_db_m=2.318)
    loss_db = acoustics.level_db(THESIS, np.array([3.0]), np.zeros(1)) - acoustics.level_db(
        thirsty, np.array([3.0]), np.zeros(1)
    )
    np.testing.assert_allclose(loss_db, 2.0 * 3.0 * 1.0)


def test_call_is_a_ramped_sine_of_312_samples() -> None:
    step = np.arange(312)
    ramp = 0.5 * (1.0 - np.cos(np.pi * np.arange(31) / 31))
    expected = np.sin(2.0 * np.pi * 40_000.0 * step / 125_000.0)
    expected[:31] *= ramp
    expected[-31:] *= ramp[::-1]
    np.testing.assert_allclose(acoustics.call(THESIS, 125_000.0).real, expected, atol=1e-12)


def test_call_lasts_as_long_as_set() -> None:
    assert len(acoustics.call(settings.Sonar(call_duration_s=0.001), 125_000.0)) == 125


def test_ramps_are_as_long_as_set() -> None:
    rises = [np.argmax(np.abs(acoustics.call(settings.Sonar(call_ramp_samples=n), 125e3)) > 0.999999) for n in (0, 50)]
    assert rises == [0, 50]


@pytest.mark.parametrize("sweep_hz", [10_000.0, -10_000.0])
def test_sweep_runs_linearly_over_its_band(sweep_hz: float) -> None:
    sweep = acoustics.call(settings.Sonar(sweep_hz=sweep_hz, call_ramp_samples=0), 2e6)
    frequency_hz = np.diff(np.unwrap(np.angle(sweep))) * 2e6 / (2.0 * np.pi)
    middle_s = (np.arange(len(frequency_hz)) + 0.5) / 2e6
    np.testing.assert_allclose(frequency_hz, 40_000.0 + sweep_hz * (middle_s / 0.0025 - 0.5), rtol=1e-6)


@pytest.mark.parametrize("is_shared", [False, True])
def test_impulse_response_equals_adding_one_tap_at_a_time(is_shared: bool) -> None:
    generator = np.random.default_rng(3)
    echoes = generator.normal(size=(3, 2, 50))
    delay = np.minimum(generator.uniform(0.0, 45.0, (3, 1, 50)), 40.0)
    expected = np.zeros((3, 2, 42))
    for bat, ear, point in np.ndindex(echoes.shape):
        first = int(np.floor(delay[bat, 0, point]))
        later = delay[bat, 0, point] - first
        if not is_shared:
            first, later = round(float(delay[bat, 0, point])), 0.0
        expected[bat, ear, first] += (1.0 - later) * echoes[bat, ear, point]
        expected[bat, ear, first + 1] += later * echoes[bat, ear, point]
    response = acoustics.impulse_response(echoes, delay, 40, is_shared=is_shared)
    np.testing.assert_allclose(response, expected[..., :40], atol=1e-12)


def test_too_late_is_not_heard() -> None:
    for is_shared in (False, True):
        assert not acoustics.impulse_response(np.ones(1), np.full(1, 40.0), 40, is_shared=is_shared).any()


def test_separated_ears_hear_the_lengths_of_their_own_paths() -> None:
    generator = np.random.default_rng(4)
    azimuth, elevation = generator.uniform(-1.5, 1.5, 9), generator.uniform(0.0, 0.5, 9)
    range_m = generator.uniform(0.2, 4.0, 9)
    point = range_m * np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    expected = [(range_m + np.linalg.norm(point - np.array([[0.0], [y], [0.0]]), axis=0)) / 2.0 for y in (0.03, -0.03)]
    path_m = acoustics.path_range_m(settings.Sonar(ear_separation_m=0.06), azimuth, elevation, range_m)
    np.testing.assert_allclose(path_m, expected, rtol=1e-12)


def test_a_miss_stays_a_miss_for_separated_ears() -> None:
    sonar, zero = settings.Sonar(ear_separation_m=0.06), np.zeros(1)
    assert np.isposinf(acoustics.path_range_m(sonar, zero, zero, np.array([np.inf]))).all()


def test_exact_arrivals_carry_the_phase_of_their_delay() -> None:
    delay_s = np.array([0.0, 1e-6, 0.0123456, 0.024])
    sonar = settings.Sonar(rendering="exact")
    real, imaginary = acoustics.arrivals(sonar, np.full((1, 4), 0.5), delay_s[None], NO_CHANCE)[0]
    np.testing.assert_allclose(real + 1j * imaginary, 0.5 * np.exp(-2j * np.pi * 40_000.0 * delay_s), atol=1e-6)


def test_incoherent_arrivals_are_energies() -> None:
    sonar = settings.Sonar(summation="incoherent")
    assert acoustics.arrivals(sonar, np.full((2, 1), 3.0), np.zeros((1, 1)), NO_CHANCE).ravel().tolist() == [9.0, 9.0]


def test_random_settings_without_a_generator_are_refused() -> None:
    with pytest.raises(ValueError, match="generator"):
        acoustics.draw_chance(settings.Sonar(level_jitter_db=1.0), [None], 5, 3000)


def test_nothing_is_drawn_where_nothing_is_random() -> None:
    generator = np.random.default_rng(0)
    assert acoustics.draw_chance(THESIS, [generator], 5, 3000) == NO_CHANCE
    assert generator.random() == np.random.default_rng(0).random()


def test_each_bat_draws_from_its_own_generator() -> None:
    sonar = settings.Sonar(level_jitter_db=2.0, summation="random_phase", receiver_noise_db=20.0)
    both = acoustics.draw_chance(sonar, [np.random.default_rng(1), np.random.default_rng(2)], 5, 30)
    second = acoustics.draw_chance(sonar, [np.random.default_rng(2)], 5, 30)
    for drawn, alone in zip(both, second, strict=True):
        assert drawn is not None
        assert alone is not None
        np.testing.assert_array_equal(drawn[1], alone[0])
