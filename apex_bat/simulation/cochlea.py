"""The periphery of the cochlea: gammatone filter, rectification, compression, low-pass, reduction to a frame.

The model is Wiegrebe's (2008, Biol. Cybern. 98:587), whose gammatone is Hohmann's (2002, Acta Acustica 88:433): four
equal complex one-pole filters. All filters run along the last axis and start from silence.

Whatever the fast path needs is written out, and scipy's filters are loaded by who calls one: their import takes 1.4 s
of CPU time, half of an actor's start.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import NUM_BINS

COMPRESSION = 0.4
"""Exponent of the compression."""
CARRIER_MEAN = math.gamma((1.0 + COMPRESSION) / 2.0) / (2.0 * math.sqrt(math.pi) * math.gamma(1.0 + COMPRESSION / 2.0))
"""0.39881: mean of a rectified and compressed sine of amplitude 1 over its period."""
LOW_PASS_HZ = 1000.0
"""Corner of the low-pass, a causal Butterworth filter of order 2."""

_GAMMATONE_ORDER = 4

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Numbers = NDArray[np.float64 | np.complex128]


def bandwidth_hz(frequency_hz: float) -> float:
    """Returns the equivalent rectangular bandwidth 24.7 + f / 9.265, here the -3 dB width of the whole filter."""
    return 24.7 + frequency_hz / 9.265


def gammatone_pole(frequency_hz: float, sample_rate_hz: float) -> complex:
    """Returns c = lambda exp(2 pi j f / fs), lambda such that four such filters lose 3 dB at half the bandwidth.

    One filter's power at an angle a off its peak is (1 - lambda)^2 / (1 - 2 lambda cos a + lambda^2), which makes
    lambda the root of a quadratic (Hohmann 2002, eqs. 13 and 14).
    """
    share = 10.0 ** (-3.0 / (10.0 * _GAMMATONE_ORDER))
    angle = math.pi * bandwidth_hz(frequency_hz) / sample_rate_hz
    half = (1.0 - share * math.cos(angle)) / (1.0 - share)
    radius = half - math.sqrt(half**2 - 1.0)
    turn = 2.0 * math.pi * frequency_hz / sample_rate_hz
    return complex(radius * math.cos(turn), radius * math.sin(turn))


def gammatone(sound: Numbers, frequency_hz: float, sample_rate_hz: float) -> Complexes:
    """Returns the output of one channel, whose amplitude is 1 for a tone of amplitude 1 at its frequency.

    The gain is 2 (1 - |c|)^4 for a real sound, of which the filter sees the positive half, and half that for an
    analytic one. The real part is the motion of the basilar membrane, the absolute value its envelope.
    """
    from scipy import signal

    pole = gammatone_pole(frequency_hz, sample_rate_hz)
    gain = (1.0 if np.iscomplexobj(sound) else 2.0) * (1.0 - abs(pole)) ** _GAMMATONE_ORDER
    motion = gain * sound.astype(np.complex128)
    for _ in range(_GAMMATONE_ORDER):  # one after another: the polynomial of all four loses digits at high rates
        motion = signal.lfilter([1.0], [1.0, -pole], motion)
    return motion


def gammatone_response(frequency_hz: float, sample_rate_hz: float, num_samples: int) -> Complexes:
    """Returns (samples,): what `gammatone` answers to an impulse of 1 in an analytic sound.

    Four equal one-pole filters make (1 - |c|)^4 c^n times the number of ways to write n as a sum of four.
    """
    pole, lag = gammatone_pole(frequency_hz, sample_rate_hz), np.arange(num_samples, dtype=np.float64)
    ways = (lag + 1.0) * (lag + 2.0) * (lag + 3.0) / 6.0
    return np.asarray((1.0 - abs(pole)) ** _GAMMATONE_ORDER * ways * pole**lag)


def filtered(sound: Numbers, response: Numbers) -> Numbers:
    """Returns a sound after the filter whose impulse response (taps,) is given; where nothing came yet, exactly 0."""
    from scipy import signal

    answer: Numbers = signal.lfilter(response, [1.0], sound)
    return answer


def rectify(motion: Floats) -> Floats:
    """Returns the positive half-waves."""
    return np.maximum(motion, 0.0)


def compress(rectified: Floats) -> Floats:
    """Returns x^0.4."""
    return np.asarray(rectified**COMPRESSION)


def butterworth(sample_rate_hz: float) -> tuple[Floats, Floats]:
    """Returns numerator and denominator, three numbers each, of the low-pass by the bilinear transform.

    With k = tan(pi f / fs) they are k^2 (1, 2, 1) and (1 + sqrt(2) k + k^2, 2 k^2 - 2, 1 - sqrt(2) k + k^2), over the
    latter's first.
    """
    k = math.tan(math.pi * LOW_PASS_HZ / sample_rate_hz)
    first = 1.0 + math.sqrt(2.0) * k + k**2
    denominator = np.array([first, 2.0 * (k**2 - 1.0), 1.0 - math.sqrt(2.0) * k + k**2])
    return k**2 / first * np.array([1.0, 2.0, 1.0]), denominator / first


def low_pass(compressed: Floats, sample_rate_hz: float) -> Floats:
    """Returns the output of a Butterworth low-pass of order 2 at 1 kHz; undershoot after an echo is cut off at 0."""
    from scipy import signal

    return np.maximum(signal.lfilter(*butterworth(sample_rate_hz), compressed), 0.0)


def block_means(samples: Floats, num_blocks: int = NUM_BINS) -> Floats:
    """Returns the means (..., num_blocks) over equal blocks of (..., samples)."""
    return np.asarray(samples.reshape(*samples.shape[:-1], num_blocks, -1).mean(axis=-1))


def channel_frequencies_hz(num_channels: int = 41, low_hz: float = 20_000.0, high_hz: float = 60_000.0) -> Floats:
    """Returns centre frequencies (channels,), evenly spaced in bandwidths of the cochlea."""
    corner_hz = 24.7 * 9.265  # bandwidth_hz is proportional to f + corner_hz
    return np.asarray(np.geomspace(low_hz + corner_hz, high_hz + corner_hz, num_channels) - corner_hz)


def cochleagram(sound: Floats, sample_rate_hz: float, frequencies_hz: Floats, num_times: int) -> NDArray[np.float32]:
    """Returns the low-passed output (..., channels, num_times) of a bank of channels for a sound (..., samples).

    The rectified and compressed carrier is replaced by its mean, K |y|^0.4: near 125 kHz / n, n samples of a period
    would beat with it.
    """
    channels = []
    for frequency_hz in frequencies_hz.tolist():
        amplitude = np.abs(gammatone(sound, frequency_hz, sample_rate_hz))
        channels.append(block_means(low_pass(CARRIER_MEAN * compress(amplitude), sample_rate_hz), num_times))
    return np.stack(channels, axis=-2).astype(np.float32)
