"""A fast cochleagram for recordings: the bank of gammatone channels as products of spectra.

`apex_bat.simulation.cochlea` filters sample by sample, 33 ms of CPU for the two ears of a call. Here each channel is a
row of its frequency response, its envelope is taken at half the sample rate, and low-pass and mean are one matrix:
3.0 ms. The values of echoes of a call differ by less than 1 % of the loudest, and as little remains in silence, where
the compression lifts what rounding and the edges of the spectrum leave: nothing that a picture shows.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from apex_bat.simulation import cochlea

NUM_CHANNELS = 31
"""Channels from 20 to 60 kHz, three in each bandwidth of the cochlea."""
NUM_TIMES = 60
"""Columns of 0.4 ms: as fine as a low-pass of 1 kHz asks for."""
_TAIL_S = 0.003  # after which the slowest channel has 1e-10 left; more would wrap around to the start
_GAMMATONE_ORDER = 4
_LEAST_POWER = np.float32(1e-36)  # instead of 0, of which numpy's power is ten times slower


def cochleagrams(sound_pa: NDArray[np.float64], sample_rate_hz: int) -> NDArray[np.float32]:
    """Returns the low-passed output of each channel, float32 (..., 31, 60), lowest frequency first.

    Args:
        sound_pa: (..., samples), 24 ms; the number of samples is a multiple of 120.
        sample_rate_hz: of the sound; above 120 kHz, so that all channels fit below its half.
    """
    bank = _bank(sound_pa.shape[-1], sample_rate_hz)
    flat = sound_pa.reshape(-1, sound_pa.shape[-1])
    # One sound after another: the arrays of one stay in the processor's cache.
    return np.stack([bank.hear(sound) for sound in flat]).reshape(*sound_pa.shape[:-1], NUM_CHANNELS, NUM_TIMES)


def frequencies_hz() -> NDArray[np.float64]:
    """Returns the centre frequencies (31,)."""
    return cochlea.channel_frequencies_hz(NUM_CHANNELS)


class _Bank:
    """Responses and matrix for sounds of one length and rate."""

    def __init__(self, num_samples: int, sample_rate_hz: int) -> None:
        num_tail = round(_TAIL_S * sample_rate_hz)
        self._num_bins = fft.next_fast_len((num_samples + num_tail + 1) // 2)
        self._num_halved = num_samples // 2
        turns = np.arange(self._num_bins) / (2 * self._num_bins)  # frequency in cycles a sample
        responses = [_gammatone_response(hz, sample_rate_hz, turns) for hz in frequencies_hz().tolist()]
        self._responses = np.array(responses, np.complex64)
        self._means = _low_pass_means(self._num_halved, sample_rate_hz / 2.0).astype(np.float32)

    def hear(self, sound_pa: NDArray[np.float64]) -> NDArray[np.float32]:
        """Returns float32 (channels, times) of a sound (samples,)."""
        spectrum = fft.rfft(sound_pa.astype(np.float32), 2 * self._num_bins)[: self._num_bins]
        # The positive half of the spectrum alone is the analytic signal at half the rate, with twice its size.
        motion = fft.ifft(spectrum * self._responses, axis=-1, overwrite_x=True)[:, : self._num_halved] / 2.0
        power = np.maximum(np.square(motion.real) + np.square(motion.imag), _LEAST_POWER)
        compressed = power ** np.float32(cochlea.COMPRESSION / 2.0)
        heard: NDArray[np.float32] = np.maximum(compressed @ self._means, np.float32(0.0))
        return heard


@lru_cache(maxsize=2)
def _bank(num_samples: int, sample_rate_hz: int) -> _Bank:
    return _Bank(num_samples, sample_rate_hz)


def _gammatone_response(
    frequency_hz: float, sample_rate_hz: float, turns: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """The channel's gain at frequencies in cycles a sample; `cochlea.gammatone` for a real sound."""
    pole = cochlea.gammatone_pole(frequency_hz, sample_rate_hz)
    one_filter = (1.0 - abs(pole)) / (1.0 - pole * np.exp(-2j * np.pi * turns))
    return np.asarray(2.0 * one_filter**_GAMMATONE_ORDER)


def _low_pass_means(num_samples: int, rate_hz: float) -> NDArray[np.float64]:
    """(samples, times): what each sample adds to the means of the low-passed envelope, the carrier's mean included."""
    impulse = np.zeros(num_samples)
    impulse[0] = 1.0
    step_response = np.append(0.0, np.cumsum(signal.lfilter(*cochlea.butterworth(rate_hz), impulse)))
    edges = np.arange(NUM_TIMES + 1) * (num_samples // NUM_TIMES)
    since = np.clip(edges - np.arange(num_samples)[:, None], 0, num_samples)
    return np.asarray(cochlea.CARRIER_MEAN * np.diff(step_response[since], axis=1) * NUM_TIMES / num_samples)
