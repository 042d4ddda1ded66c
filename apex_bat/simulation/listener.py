"""The fast ear of the environment: frames of many bats at once, for rays whose directions are fixed.

It gives the frame of `Sonar.hear`, and to each bat the same bits alone and among others: what is done for several bats
at once is element by element or a stack of products of one bat's arrays, and what depends on how a bat's echoes lie is
done for one bat after another.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.experience import NUM_BINS, NUM_EARS
from apex_bat.simulation import acoustics, cochlea
from apex_bat.simulation.block_filters import BlockFilter, BlockLowPass
from apex_bat.simulation.directivity import directivity_db
from apex_bat.simulation.receiver import LISTENING_S, receiver

_CHANNEL_BLOCK = {"thesis": 48, "exact": 24}  # samples; measured: fastest
_LOW_PASS_BLOCK = {"thesis": 50, "exact": 48}
_BATS_TOGETHER = 4  # keeps arrays below what malloc asks of the kernel each time, which had cost 3 us a page
_SILENCE = np.float32(1e-37)  # instead of 0, whose logarithm is not finite

Floats = NDArray[np.float64]


class Listener:
    """A bat's ears behind a range sensor with fixed rays; made by `Sonar.listener`. It serves one thread."""

    def __init__(self, sonar: settings.Sonar, azimuth_rad: Floats, elevation_rad: Floats) -> None:
        """Takes settings and the rays' directions, (points,) each."""
        self._sonar, self._is_thesis = sonar, sonar.rendering == "thesis"
        self._azimuth_rad, self._elevation_rad = azimuth_rad, elevation_rad
        directivity = directivity_db(sonar, azimuth_rad, elevation_rad)
        self._gain_pa = acoustics.pressure_pa(sonar.call_level_db + directivity)
        self._floor_pa = acoustics.pressure_pa(sonar.floor_db)
        self._decay_m = acoustics.absorption_db_m(sonar) * np.log(10.0) / 10.0  # 2 a r dB as a factor exp(-decay r)
        self._receiver = receiver(sonar)
        self._num_samples, rate_hz = self._receiver.num_samples, self._receiver.sample_rate_hz
        num_parts = 1 if self._is_thesis else 2
        self._num_parts = num_parts
        self._channel = self._block_filter(self._receiver.response, 1 if sonar.summation == "incoherent" else num_parts)
        self._noise_channel = self._block_filter(self._receiver.noise_pa * self._receiver.noise_response, num_parts)
        self._low_pass = BlockLowPass(rate_hz, self._num_samples, _LOW_PASS_BLOCK[sonar.rendering])
        samples_of_value = self._num_samples // NUM_BINS
        scale = 1.0 if self._is_thesis else cochlea.CARRIER_MEAN
        self._average = np.full(samples_of_value, scale / samples_of_value, np.float32)
        phase = 2.0 * np.pi * sonar.frequency_hz / rate_hz * np.arange(self._num_samples)
        carrier = np.sin(phase) if self._is_thesis else np.ones(self._num_samples)
        self._carrier = carrier.astype(np.float32)

    def frames(
        self, range_m: NDArray[np.float32], generators: Sequence[np.random.Generator] | None = None
    ) -> NDArray[np.float32]:
        """Returns the echo frames of some bats.

        Args:
            range_m: (bats, points), greater than 0; inf is a miss.
            generators: one a bat; used only where a setting is random.

        Returns:
            float32 (bats, 2, 24), ears left and right; the frame of `Sonar.hear`.

        Raises:
            ValueError: the shape does not fit the rays, a range is NaN or not positive, or generators are missing.
        """
        num_bats, num_points = len(range_m), len(self._azimuth_rad)
        if range_m.shape != (num_bats, num_points):
            raise ValueError(f"range_m has shape {range_m.shape}, but the listener has {num_points} rays a bat")
        if not range_m.min(initial=np.inf) > 0.0:
            raise ValueError("range_m must be greater than 0 (inf is a miss); it has other values or NaN")
        if generators is not None and len(generators) != num_bats:
            raise ValueError(f"{len(generators)} generators were given for {num_bats} bats")
        drawn_from: Sequence[np.random.Generator | None] = generators or [None] * num_bats
        frames = np.empty((num_bats, NUM_EARS, NUM_BINS), np.float32)
        for first in range(0, num_bats, _BATS_TOGETHER):
            some = slice(first, first + _BATS_TOGETHER)
            chance = acoustics.draw_chance(self._sonar, drawn_from[some], num_points, self._num_samples)
            motion = self._motion(range_m[some], chance)
            envelope = self._low_pass(self._compressed(motion).reshape(-1, self._num_samples))
            np.maximum(envelope, 0.0, out=envelope)
            values = envelope.reshape(-1, NUM_BINS, len(self._average)) @ self._average
            frames[some] = values.reshape(-1, NUM_EARS, NUM_BINS)
        return frames

    def _block_filter(self, response: NDArray[np.float64 | np.complex128], num_parts: int) -> BlockFilter:
        """Returns the filter of both ears for sounds of some parts, which a complex response mixes."""
        block = _CHANNEL_BLOCK[self._sonar.rendering]
        if not np.iscomplexobj(response):
            return BlockFilter(response.real[None, None], num_parts, self._num_samples, block)
        real, imaginary = response.real, response.imag
        mixing = np.array(((real, imaginary), (-imaginary, real)))
        return BlockFilter(mixing[:, :1] if self._is_thesis else mixing, 2, self._num_samples, block)

    def _motion(self, range_m: NDArray[np.float32], chance: acoustics.Chance) -> NDArray[np.float32]:
        """Returns what moves in some bats' channels, (bats, 2, parts, samples): at 125 kHz, or in the baseband."""
        echoes, delay_samples = self._arrivals(range_m.astype(np.float64), chance)
        first_samples = delay_samples.min(axis=(1, 2, 3), initial=self._num_samples).astype(np.int64).tolist()
        taps = acoustics.impulse_response(echoes, delay_samples, self._num_samples, is_shared=not self._is_thesis)
        motion = np.empty((len(range_m), NUM_EARS, self._num_parts, self._num_samples), np.float32)
        for bat, first in enumerate(first_samples):
            self._channel.sound[:] = taps[bat]
            filtered = self._channel(first)
            if self._sonar.summation == "incoherent":
                filtered = np.sqrt(filtered) * self._carrier
            motion[bat, :, : filtered.shape[1]] = filtered
            motion[bat, :, filtered.shape[1] :] = 0.0
            if chance.noise is not None:
                self._noise_channel.sound[:] = chance.noise[bat]
                motion[bat] += self._noise_channel()
        return motion

    def _arrivals(self, range_m: Floats, chance: acoustics.Chance) -> tuple[Floats, Floats]:
        """Returns what each point adds to the impulse responses, (bats, 2, parts, points), and when, in samples.

        Eq. 3.1.1 as a product of pressures, of which the directions' part is known before.
        """
        path_m = acoustics.path_range_m(self._sonar, self._azimuth_rad, self._elevation_rad, range_m)
        near = acoustics.REFERENCE_RANGE_M / path_m
        spread = near * near * np.exp(-self._decay_m * path_m)
        if chance.jitter_db is not None:
            spread = spread * 10.0 ** (chance.jitter_db / 20.0)
        pressure_pa = spread * self._gain_pa
        pressure_pa *= pressure_pa >= self._floor_pa
        delay_s = np.minimum(path_m * (2.0 / self._sonar.speed_of_sound_m_s), LISTENING_S)
        echoes = acoustics.arrivals(self._sonar, pressure_pa, delay_s, chance)
        return echoes, delay_s[..., None, :] * self._receiver.sample_rate_hz

    def _compressed(self, motion: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the rectified and compressed motion (bats, 2, samples); in the baseband |y|^0.4, without its factor.

        x^0.4 is computed as exp(0.4 ln x), which is twice as fast as numpy's power and as exact as the rest.
        """
        amplitude = motion[:, :, 0] if self._is_thesis else np.square(motion).sum(axis=2)
        exponent = cochlea.COMPRESSION if self._is_thesis else cochlea.COMPRESSION / 2.0
        logarithm = np.log(np.maximum(amplitude, _SILENCE))
        logarithm *= np.float32(exponent)
        return np.exp(logarithm, out=logarithm)
