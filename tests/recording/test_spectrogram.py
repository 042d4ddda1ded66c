"""The fast cochleagram is the slow one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from apex_bat.config.settings import Sonar
from apex_bat.recording.spectrogram import NUM_TIMES, cochleagrams, frequencies_hz
from apex_bat.simulation import acoustics, cochlea

RATE_HZ = 125_000
NUM_SAMPLES = 3000


def echoes() -> NDArray[np.float64]:
    """Two sounds made of calls as the bat makes them, at 8 and 10 ms, and at 16 and 21 ms; silent before."""
    call = acoustics.call(Sonar(), RATE_HZ).real
    sounds = np.zeros((2, NUM_SAMPLES))
    for sound, first, gain in ((0, 1000, 0.1), (0, 1250, 0.02), (1, 2000, 1.0), (1, 2640, 0.003)):
        sounds[sound, first : first + len(call)] += gain * call
    return sounds


def test_it_equals_the_filters_of_the_cochlea() -> None:
    slow = cochlea.cochleagram(echoes(), RATE_HZ, frequencies_hz(), NUM_TIMES)
    np.testing.assert_allclose(cochleagrams(echoes(), RATE_HZ), slow, atol=0.01 * slow.max())


def test_noise_of_the_receiver_is_as_loud_as_there() -> None:
    noise = 0.01 * np.random.default_rng(3).standard_normal((2, NUM_SAMPLES))
    slow = cochlea.cochleagram(noise, RATE_HZ, frequencies_hz(), NUM_TIMES)
    np.testing.assert_allclose(cochleagrams(noise, RATE_HZ).mean(axis=-1), slow.mean(axis=-1), rtol=0.02)


def test_silence_stays_silent_before_a_sound_and_does_not_wrap_around() -> None:
    heard = cochleagrams(echoes(), RATE_HZ)
    assert heard[0, :, :20].max() < 0.01 * heard[0].max()
    assert heard[1, :, :40].max() < 0.01 * heard[1].max()


@pytest.mark.parametrize("tone_hz", [25_000.0, 40_000.0, 55_000.0])
def test_a_tone_is_loudest_in_its_channel(tone_hz: float) -> None:
    sound = np.sin(2 * np.pi * tone_hz / RATE_HZ * np.arange(NUM_SAMPLES))
    loudest_hz = frequencies_hz()[cochleagrams(sound, RATE_HZ)[:, -1].argmax()]
    assert abs(loudest_hz - tone_hz) < 0.5 * cochlea.bandwidth_hz(tone_hz)


def test_each_sound_is_heard_alone() -> None:
    sounds = echoes()
    np.testing.assert_array_equal(cochleagrams(sounds, RATE_HZ)[1], cochleagrams(sounds[1], RATE_HZ))
