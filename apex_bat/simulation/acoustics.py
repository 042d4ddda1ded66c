"""From reflecting points to sound: absorption, levels, pressures, the call, and the sum of its echoes.

Pure functions of arrays; `...` stands for nothing or for an axis of bats. The model is that of Mohan & Vanderelst
(2020), section 3.1, whose eq. 3.1.1 gives the level of each point; absorption follows ISO 9613-1:1993.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.experience import NUM_EARS

REFERENCE_PRESSURE_PA = 2e-5
"""Pressure of 0 dB SPL."""
REFERENCE_RANGE_M = 0.1
"""Distance at which the level of the call is stated (thesis eq. 3.1.1)."""

Floats = NDArray[np.float64]


class Chance(NamedTuple):
    """What chance adds to the calls of some bats; a part is None where the settings leave nothing to chance."""

    jitter_db: Floats | None
    """(bats, 1, points): change of each reflector's level."""
    phase_cycles: Floats | None
    """(bats, 1, points): phase of each reflector, in cycles of the carrier."""
    noise: Floats | None
    """(bats, 2, parts, samples): white noise of variance 1 at each ear; in the baseband, real and imaginary part."""


NO_CHANCE = Chance(None, None, None)


def draw_chance(
    sonar: settings.Sonar, generators: Sequence[np.random.Generator | None], num_points: int, num_samples: int
) -> Chance:
    """Returns the random numbers of one call of each bat, drawn from its generator in the order of the fields.

    Raises:
        ValueError: a random setting is on and a generator is missing.
    """
    if not sonar.is_random:
        return NO_CHANCE
    jitter_db: list[Floats] = []
    phase_cycles: list[Floats] = []
    noise: list[Floats] = []
    for generator in generators:
        if generator is None:
            raise ValueError('level_jitter_db, receiver_noise_db and summation = "random_phase" need a generator')
        if sonar.level_jitter_db > 0.0:
            jitter_db.append(sonar.level_jitter_db * generator.standard_normal((1, num_points)))
        if sonar.summation == "random_phase":
            phase_cycles.append(generator.random((1, num_points)))
        if sonar.receiver_noise_db is not None:
            num_parts = 1 if sonar.rendering == "thesis" else 2
            noise.append(generator.standard_normal((NUM_EARS, num_parts, num_samples)))
    return Chance(
        jitter_db=np.stack(jitter_db) if jitter_db else None,
        phase_cycles=np.stack(phase_cycles) if phase_cycles else None,
        noise=np.stack(noise) if noise else None,
    )


def absorption_db_m(sonar: settings.Sonar) -> float:
    """Returns the one-way absorption of the air: the setting, or ISO 9613-1 from temperature and humidity."""
    if sonar.absorption_db_m is not None:
        return sonar.absorption_db_m
    if sonar.temperature_c is None or sonar.humidity_percent is None:
        raise ValueError("absorption_db_m is None, so temperature_c and humidity_percent must both be set")
    return iso_absorption_db_m(sonar.frequency_hz, sonar.temperature_c, sonar.humidity_percent)


def iso_absorption_db_m(frequency_hz: float, temperature_c: float, humidity_percent: float) -> float:
    """Returns the absorption of air at one atmosphere, dB/m (ISO 9613-1:1993, eqs. 3 to 5, B.2 and B.3)."""
    kelvin = temperature_c + 273.15
    ratio = kelvin / 293.15
    saturation = 10.0 ** (-6.8346 * (273.16 / kelvin) ** 1.261 + 4.6151)
    vapour = humidity_percent * saturation  # molar concentration of water, percent
    oxygen_hz = 24.0 + 4.04e4 * vapour * (0.02 + vapour) / (0.391 + vapour)
    nitrogen_hz = ratio**-0.5 * (9.0 + 280.0 * vapour * math.exp(-4.170 * (ratio ** (-1 / 3) - 1.0)))
    oxygen = 0.01275 * math.exp(-2239.1 / kelvin) / (oxygen_hz + frequency_hz**2 / oxygen_hz)
    nitrogen = 0.1068 * math.exp(-3352.0 / kelvin) / (nitrogen_hz + frequency_hz**2 / nitrogen_hz)
    classical = 1.84e-11 * ratio**0.5
    return float(8.686 * frequency_hz**2 * (classical + ratio**-2.5 * (oxygen + nitrogen)))


def path_range_m(sonar: settings.Sonar, azimuth_rad: Floats, elevation_rad: Floats, range_m: Floats) -> Floats:
    """Returns half the path from the mouth over each point to each ear.

    Args:
        sonar: its `ear_separation_m`; the ears lie on the y axis, the mouth between them.
        azimuth_rad: (..., points).
        elevation_rad: (..., points).
        range_m: (..., points), from the mouth.

    Returns:
        (..., 2, points), or (..., 1, points) where both ears are at the mouth.
    """
    range_m = range_m[..., None, :]
    if sonar.ear_separation_m == 0.0:
        return range_m
    leftward = np.sin(azimuth_rad) * np.cos(elevation_rad)
    towards_ear = np.stack((leftward, -leftward), axis=-2)
    nearness = sonar.ear_separation_m / 2.0 / range_m  # law of cosines in units of the range: a miss at inf stays one
    return np.asarray(range_m * (1.0 + np.sqrt(1.0 + nearness * (nearness - 2.0 * towards_ear))) / 2.0)


def level_db(sonar: settings.Sonar, range_m: Floats, directivity_db: Floats) -> Floats:
    """Returns g = call + 40 log10(0.1 / r) - 2 a r + d, the level of each point, dB SPL (thesis eq. 3.1.1)."""
    with np.errstate(divide="ignore"):  # a miss at inf has the level -inf
        spreading_db = 40.0 * np.log10(REFERENCE_RANGE_M / range_m)
    return sonar.call_level_db + spreading_db - 2.0 * absorption_db_m(sonar) * range_m + directivity_db


def pressure_pa(sound_level_db: Floats | float) -> Floats:
    """Returns 2e-5 Pa * 10^(g / 20), the amplitude of an echo of g dB SPL."""
    return np.asarray(REFERENCE_PRESSURE_PA * 10.0 ** (np.asarray(sound_level_db) / 20.0))


def call(sonar: settings.Sonar, sample_rate_hz: float) -> NDArray[np.complex128]:
    """Returns the analytic call (samples,) of amplitude 1; its real part is the sound, a sine or a linear sweep.

    Its raised-cosine ramps of n samples are 0.5 (1 - cos(pi k / n)), mirrored at the end.
    """
    num_samples = math.floor(sonar.call_duration_s * sample_rate_hz + 1e-6)
    num_ramp = round(sonar.call_ramp_samples * sample_rate_hz / sonar.sample_rate_hz)
    time_s = np.arange(num_samples) / sample_rate_hz
    sweep_hz_s = sonar.sweep_hz / sonar.call_duration_s
    cycles = (sonar.frequency_hz - sonar.sweep_hz / 2.0) * time_s + sweep_hz_s * time_s**2 / 2.0
    ramp = 0.5 * (1.0 - np.cos(np.pi * np.arange(num_ramp) / max(num_ramp, 1)))
    envelope = np.ones(num_samples)
    envelope[:num_ramp] *= ramp
    envelope[num_samples - num_ramp :] *= ramp[::-1]
    return np.asarray(-1j * envelope * np.exp(2j * np.pi * cycles))


def arrivals(sonar: settings.Sonar, pressure_pa: Floats, delay_s: Floats, chance: Chance) -> Floats:
    """Returns what each point adds to the impulse response of its rendering.

    Args:
        sonar: its rendering, frequency and summation.
        pressure_pa: (..., 2, points).
        delay_s: (..., 1 or 2, points), finite.
        chance: the reflectors' phases, if they are random.

    Returns:
        (..., 2, parts, points). One part: the pressure, squared where energies add. Two: real and imaginary part of the
        pressure turned by the reflector's phase and, in the exact rendering, by exp(-2 pi j f delay).
    """
    if sonar.summation == "incoherent":
        return np.square(pressure_pa)[..., None, :]
    cycles = -sonar.frequency_hz * delay_s if sonar.rendering == "exact" else None
    if chance.phase_cycles is not None:
        cycles = chance.phase_cycles if cycles is None else cycles + chance.phase_cycles
    if cycles is None:
        return pressure_pa[..., None, :]
    angle = (2.0 * np.pi * (cycles - np.floor(cycles))).astype(np.float32)  # exact to 1e-7 rad without whole cycles
    return np.asarray(pressure_pa[..., None, :] * np.stack((np.cos(angle), np.sin(angle)), axis=-2))


def impulse_response(echoes: Floats, delay_samples: Floats, num_samples: int, *, is_shared: bool) -> Floats:
    """Returns the sum of all echoes' taps.

    Args:
        echoes: (..., points), amplitude of each echo.
        delay_samples: broadcasts to (..., points), at most `num_samples`, which is not heard any more.
        num_samples: length of the answer.
        is_shared: whether a tap between two samples is shared between them linearly, or its delay rounded.

    Returns:
        (..., num_samples).
    """
    whole = np.floor(delay_samples) if is_shared else np.rint(delay_samples)
    length = num_samples + 1  # what comes too late falls into the last sample, which is cut off
    shape = echoes.shape[:-1]
    row_starts = np.arange(0.0, length * math.prod(shape), length).reshape(*shape, 1)
    index = (whole + row_starts).astype(np.intp).ravel()
    taps = np.bincount(index, echoes.ravel(), minlength=row_starts.size * length).reshape(*shape, length)
    if is_shared:
        later = (echoes * (delay_samples - whole)).ravel()
        moved = np.bincount(index, later, minlength=row_starts.size * length).reshape(*shape, length)
        taps -= moved
        taps[..., 1:] += moved[..., :-1]
    return taps[..., :num_samples].astype(np.float64, copy=False)
