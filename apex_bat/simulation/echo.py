"""One call as a bat hears it, stage by stage (thesis fig. 3.6)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.simulation import acoustics, cochlea
from apex_bat.simulation.receiver import LISTENING_S, Receiver

COCHLEAGRAM_TIMES = 120
"""Columns of a cochleagram, 0.2 ms each."""

Floats = NDArray[np.float64]
Numbers = NDArray[np.float64 | np.complex128]


@dataclass(frozen=True, eq=False)
class Echo:
    """What a bat hears of one call. Each stage is computed when it is first looked at.

    `...` is nothing for one bat, or the axis of bats; ears are left, right. The samples of the stages are at 125 kHz
    (3000) in the rendering `thesis`, in the complex baseband at 24 kHz (576) in `exact`: 24 ms in both.
    """

    settings: settings.Sonar
    receiver: Receiver
    level_db: Floats
    """(..., 2, points): level of each point at each ear, dB SPL; -inf is a miss. Points below the floor are silent."""
    arrivals: Floats
    """(..., 2, parts, points): what each point adds to the impulse response; see `acoustics.arrivals`."""
    delay_s: Floats
    """(..., 1 or 2, points): when each point is heard, after the start of the call; 24 ms is too late."""
    noise_parts_pa: Floats | None
    """(..., 2, parts, samples): white noise at the ears, or None; real and imaginary part in the baseband."""

    @property
    def sample_rate_hz(self) -> int:
        """Sample rate of the stages."""
        return self.receiver.sample_rate_hz

    @cached_property
    def noise_pa(self) -> Numbers | None:
        """(..., 2, samples): white noise at the ears, or None; complex in `exact`."""
        return None if self.noise_parts_pa is None else _as_numbers(self.noise_parts_pa)

    @cached_property
    def impulse_response(self) -> Numbers:
        """(..., 2, samples): the sum of all points, Pa; Pa squared where energies add."""
        return self._impulse_response(self.sample_rate_hz)

    @cached_property
    def pressure_pa(self) -> Floats | None:
        """(..., 2, 3000): the sound at each ear, noise included; None in the rendering `exact`."""
        return self._sound_pa if self._is_thesis else None

    @cached_property
    def gammatone(self) -> Numbers:
        """(..., 2, samples): motion in the cochlea's channel at the call's frequency, Pa; in `exact` its baseband."""
        if self.pressure_pa is not None and not self._is_incoherent:
            return cochlea.gammatone(self.pressure_pa, self.settings.frequency_hz, self.sample_rate_hz).real
        motion = cochlea.filtered(self.impulse_response, self.receiver.response)
        if self._is_incoherent:
            motion = np.sqrt(motion.real) * (self._carrier(self.sample_rate_hz).real if self._is_thesis else 1.0)
        if self.noise_pa is not None:
            return np.asarray(motion + cochlea.filtered(self.noise_pa, self.receiver.noise_response))
        return motion

    @cached_property
    def rectified(self) -> Floats:
        """(..., 2, samples): the positive half-waves, Pa; in `exact` the amplitude of the carrier."""
        return cochlea.rectify(self.gammatone.real) if self._is_thesis else np.abs(self.gammatone)

    @cached_property
    def compressed(self) -> Floats:
        """(..., 2, samples): x^0.4 of the rectified motion; in `exact` its mean over the carrier, K x^0.4."""
        return cochlea.compress(self.rectified) * (1.0 if self._is_thesis else cochlea.CARRIER_MEAN)

    @cached_property
    def envelope(self) -> Floats:
        """(..., 2, samples): the low-passed output of the cochlea."""
        return cochlea.low_pass(self.compressed, self.sample_rate_hz)

    @cached_property
    def frame(self) -> NDArray[np.float32]:
        """(..., 2, 24): what the policy sees, means of the envelope over 1 ms."""
        return cochlea.block_means(self.envelope).astype(np.float32)

    @property
    def cochleagram_hz(self) -> Floats:
        """(channels,): centre frequencies of the cochleagram, 20 to 60 kHz."""
        return cochlea.channel_frequencies_hz()

    @cached_property
    def cochleagram(self) -> NDArray[np.float32]:
        """(..., 2, channels, 120): the envelope of each channel of `cochleagram_hz`, means over 0.2 ms."""
        sound_rate_hz = self.settings.sample_rate_hz
        return cochlea.cochleagram(self._sound_pa, sound_rate_hz, self.cochleagram_hz, COCHLEAGRAM_TIMES)

    @property
    def _is_thesis(self) -> bool:
        return self.settings.rendering == "thesis"

    @property
    def _is_incoherent(self) -> bool:
        return self.settings.summation == "incoherent"

    def _impulse_response(self, rate_hz: int) -> Numbers:
        """Returns the sum of all points (..., 2, samples) at some sample rate."""
        num_samples = round(LISTENING_S * rate_hz)
        delay_samples = self.delay_s[..., None, :] * rate_hz
        return _as_numbers(
            acoustics.impulse_response(self.arrivals, delay_samples, num_samples, is_shared=not self._is_thesis)
        )

    def _carrier(self, rate_hz: int) -> NDArray[np.complex128]:
        """Returns (samples,): an analytic tone of the call's frequency and phase, whose real part is a sine."""
        cycles = self.settings.frequency_hz / rate_hz * np.arange(round(LISTENING_S * rate_hz))
        return np.asarray(-1j * np.exp(2j * np.pi * cycles))

    @cached_property
    def _sound_pa(self) -> Floats:
        """(..., 2, 3000): the sound at 125 kHz. `exact` adds the carrier to its baseband again, for the cochleagram."""
        rate_hz = self.settings.sample_rate_hz
        call, carrier = acoustics.call(self.settings, rate_hz), self._carrier(rate_hz)
        taps = self._impulse_response(rate_hz)
        if self._is_incoherent:
            sound = np.sqrt(cochlea.filtered(taps, np.square(np.abs(call))).real) * carrier.real
        elif self._is_thesis:
            sound = cochlea.filtered(taps, call).real
        else:
            sound = (cochlea.filtered(taps, call / carrier[: len(call)]) * carrier).real
        if self.noise_pa is None:
            return np.asarray(sound)
        if self._is_thesis:
            return np.asarray(sound + self.noise_pa)
        from scipy import signal  # here: see `cochlea`

        return np.asarray(sound + (signal.resample(self.noise_pa, len(carrier), axis=-1) * carrier).real)


def _as_numbers(parts: Floats) -> Numbers:
    """Returns numbers (..., samples) of their parts (..., 1, samples), or (..., 2, samples): real, imaginary."""
    return parts[..., 0, :] if parts.shape[-2] == 1 else parts[..., 0, :] + 1j * parts[..., 1, :]
