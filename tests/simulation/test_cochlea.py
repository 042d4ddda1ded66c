"""The gammatone, the compression and the low-pass against their stated figures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from apex_bat.simulation import cochlea

RATE_HZ = 125_000.0


def impulse_answer(num_samples: int = 400) -> np.ndarray:
    impulse = np.zeros(num_samples)
    impulse[0] = 1.0
    return cochlea.gammatone(impulse, 40_000.0, RATE_HZ)


def test_pole_at_40_khz_has_the_stated_radius() -> None:
    pole = cochlea.gammatone_pole(40_000.0, RATE_HZ)
    assert abs(pole) == pytest.approx(0.77836, abs=5e-6)
    assert np.angle(pole) == pytest.approx(2.0 * np.pi * 0.32)


def test_gammatone_peaks_at_0_db_and_is_one_bandwidth_wide() -> None:
    frequency_hz = np.arange(35_000.0, 45_000.0, 1.0)
    gain = np.abs(signal.freqz(impulse_answer().real, worN=frequency_hz, fs=RATE_HZ)[1])
    assert gain[5000] == pytest.approx(1.0, abs=2e-3)
    passing = frequency_hz[gain >= gain.max() * 10.0 ** (-3.0 / 20.0)]
    assert passing[-1] - passing[0] == pytest.approx(cochlea.bandwidth_hz(40_000.0), rel=2e-3)


@pytest.mark.parametrize("rate_hz", [125_000.0, 24_000.0 * 64])
def test_the_impulse_response_written_out_is_what_the_four_filters_answer(rate_hz: float) -> None:
    impulse = np.zeros(5000, np.complex128)
    impulse[0] = 1.0
    expected = cochlea.gammatone(impulse, 40_000.0, rate_hz)
    found = cochlea.gammatone_response(40_000.0, rate_hz, 5000)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("rate_hz", [24_000.0, 125_000.0, 1_000_000.0])
def test_the_low_pass_is_the_butterworth_filter_of_scipy(rate_hz: float) -> None:
    expected = signal.butter(2, cochlea.LOW_PASS_HZ, fs=rate_hz)
    for found, right in zip(cochlea.butterworth(rate_hz), expected, strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-9)


def test_envelope_of_the_impulse_response_peaks_after_80_us() -> None:
    assert np.argmax(np.abs(impulse_answer())) / RATE_HZ == pytest.approx(80e-6)


def test_tone_passes_its_own_channel_with_its_amplitude() -> None:
    tone = np.sin(2.0 * np.pi * 30_000.0 * np.arange(4000) / RATE_HZ)
    assert np.abs(cochlea.gammatone(tone, 30_000.0, RATE_HZ))[2000:].mean() == pytest.approx(1.0, abs=2e-3)


def test_analytic_tone_passes_with_its_amplitude_too() -> None:
    tone = np.exp(2j * np.pi * 30_000.0 * np.arange(4000) / RATE_HZ)
    np.testing.assert_allclose(np.abs(cochlea.gammatone(tone, 30_000.0, RATE_HZ))[2000:], 1.0, atol=1e-9)


def test_carrier_mean_is_that_of_a_rectified_compressed_sine() -> None:
    sine = np.sin(2.0 * np.pi * (np.arange(1_000_000) + 0.5) / 1_000_000)
    assert round(cochlea.CARRIER_MEAN, 5) == 0.39881
    assert cochlea.compress(cochlea.rectify(sine)).mean() == pytest.approx(cochlea.CARRIER_MEAN, rel=1e-6)


def test_low_pass_loses_3_db_at_1_khz_and_12_db_an_octave_above() -> None:
    time_s = np.arange(20_000) / RATE_HZ
    swings = [
        np.ptp(cochlea.low_pass(1.0 + 0.5 * np.sin(2.0 * np.pi * hz * time_s), RATE_HZ)[10_000:])
        for hz in (10.0, 1000.0, 4000.0)
    ]
    assert swings[1] == pytest.approx(2.0**-0.5, rel=1e-3)
    assert swings[2] == pytest.approx(1.0 / np.sqrt(1.0 + 4.0**4), rel=0.02)


def test_low_pass_never_undershoots() -> None:
    burst = np.zeros(3000)
    burst[:300] = 1.0
    envelope = cochlea.low_pass(burst, RATE_HZ)
    assert envelope.min() == 0.0
    assert envelope[300:350].min() > 0.0


def test_block_means_are_means_over_blocks() -> None:
    np.testing.assert_array_equal(cochlea.block_means(np.arange(12.0), 3), [1.5, 5.5, 9.5])


def test_channels_run_from_20_to_60_khz_in_steps_of_equal_bandwidths() -> None:
    frequency_hz = cochlea.channel_frequencies_hz()
    steps = np.diff(frequency_hz) / [cochlea.bandwidth_hz(hz) for hz in np.sqrt(frequency_hz[1:] * frequency_hz[:-1])]
    assert frequency_hz[[0, -1]] == pytest.approx([20_000.0, 60_000.0])
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)


@pytest.mark.parametrize("tone_hz", [25_000.0, 40_000.0, 55_000.0])
def test_tone_is_loudest_in_its_channel_of_the_cochleagram(tone_hz: float) -> None:
    sound = np.sin(2.0 * np.pi * tone_hz * np.arange(3000) / RATE_HZ)
    frequency_hz = cochlea.channel_frequencies_hz(21)
    heard = cochlea.cochleagram(sound, RATE_HZ, frequency_hz, 24)
    assert heard.shape == (21, 24)
    assert np.argmax(heard.mean(axis=1)) == np.argmin(np.abs(frequency_hz - tone_hz))
