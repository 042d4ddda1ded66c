"""The two renderings of an echo as linear filters: the thesis's 125 kHz chain, and its complex baseband.

Call and gammatone are linear, so one filter stands for both. `thesis` filters the sound, with delays rounded to 8 us.
`exact` moves the carrier to 0: an echo of amplitude p and delay t adds p exp(-2 pi j f t), shared between two samples
of 24 kHz, and the mean of the rectified and compressed carrier is K |y|^0.4. (8 us are up to 58 degrees of the carrier,
so that the two are different draws of the speckle.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.simulation import acoustics, cochlea

LISTENING_S = 0.024
"""How long the bat listens from the start of a call: 4.116 m of range, 1 ms for each value of the frame."""

_BASEBAND_HZ = 24_000
_FINE_FACTOR = 84  # the baseband filter is sampled from one at 2.016 MHz
_TAIL_S = 0.003  # the gammatone filter at 20 kHz, the slowest, has 1e-10 left after this
_NEGLIGIBLE = 1e-11  # of a filter's peak: cut off, for even compressed it adds less than 1e-6 to a value of a frame

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Numbers = NDArray[np.float64 | np.complex128]


class Receiver(NamedTuple):
    """What turns the arriving echoes into the motion of the cochlea's channel, in one rendering."""

    sample_rate_hz: int
    num_samples: int
    response: Numbers
    """(taps,): the channel's answer to an echo of amplitude 1; its squared envelope where energies add."""
    noise_response: Floats
    """(taps,): the channel's answer to an impulse."""
    noise_pa: float
    """Standard deviation of the white noise (of each of its parts, in the baseband); 0 for none."""


def receiver(sonar: settings.Sonar) -> Receiver:
    """Returns the filters of the rendering that the settings ask for."""
    is_thesis = sonar.rendering == "thesis"
    rate_hz, step = (sonar.sample_rate_hz, 1) if is_thesis else (_BASEBAND_HZ, _FINE_FACTOR)
    call = acoustics.call(sonar, rate_hz * step)
    impulse = np.array([float(step)])  # its area is 1 when every step-th sample is taken
    response: Numbers
    if sonar.summation == "incoherent":
        response = np.square(np.abs(_baseband(sonar, call, rate_hz, step)))
    elif not is_thesis:
        response = _baseband(sonar, call, rate_hz, step)
        response = response if sonar.sweep_hz else response.real  # a tone's is real, which makes it cheaper
    else:
        response = _channel(sonar, call.real, rate_hz).real
        if sonar.summation == "random_phase":  # Re{a (x + j y)} is then the answer to the call turned by the phase of a
            response = response + 1j * _channel(sonar, call.imag, rate_hz).real
    heard = _channel(sonar, impulse, rate_hz) if is_thesis else _baseband(sonar, -1j * impulse, rate_hz, step)
    noise_response = _trimmed(heard.real).real
    return Receiver(
        sample_rate_hz=rate_hz,
        num_samples=round(LISTENING_S * rate_hz),
        response=_trimmed(response),
        noise_response=noise_response,
        noise_pa=_noise_pa(sonar, noise_response),
    )


def _channel(sonar: settings.Sonar, sound: Numbers, rate_hz: int) -> Complexes:
    """Returns the channel's answer to a sound until it has died away."""
    num_samples = len(sound) + round(_TAIL_S * rate_hz)
    response = cochlea.gammatone_response(sonar.frequency_hz, rate_hz, num_samples)
    gain = 1.0 if np.iscomplexobj(sound) else 2.0  # of a real sound the filter sees the positive half
    size = 1 << (2 * num_samples - 1).bit_length()  # both fit twice: nothing comes round
    answer = np.fft.ifft(np.fft.fft(sound, size) * np.fft.fft(response, size))[:num_samples]
    return np.asarray(gain * answer)


def _baseband(sonar: settings.Sonar, sound: Complexes, rate_hz: int, step: int) -> Complexes:
    """Returns the channel's answer to a sound at rate x step, its carrier (a sine) moved to 0, in each step-th sample.

    Each sample is taken in the middle of its interval: the error of a frame is 1.3 % so, and 1.5 % otherwise.
    """
    motion = _channel(sonar, sound, rate_hz * step)
    cycles = sonar.frequency_hz / (rate_hz * step) * np.arange(len(motion))
    return np.asarray(1j * motion * np.exp(-2j * np.pi * cycles))[step // 2 :: step]


def _noise_pa(sonar: settings.Sonar, noise_response: Floats) -> float:
    """Returns how strong noise is whose power in the channel is p^2 / 2, that of a tone of the same level."""
    if sonar.receiver_noise_db is None:
        return 0.0
    return float(acoustics.pressure_pa(sonar.receiver_noise_db) / np.sqrt(2.0 * np.square(noise_response).sum()))


def _trimmed(response: Numbers) -> Numbers:
    """Returns a filter up to its last tap that matters."""
    size = np.abs(response)
    return response[: int(np.flatnonzero(size > _NEGLIGIBLE * size.max())[-1]) + 1]
