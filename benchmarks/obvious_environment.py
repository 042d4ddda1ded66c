"""The yardstick: one bat simulated the obvious way.

PyBullet's `rayTestBatch` for 1000 + 360 rays, and the 125 kHz chain written down as the equations stand, with
`numpy.convolve` and `scipy.signal.lfilter`, for each ear. The physics is that of `apex_bat.simulation` in its default
settings, so that the two can be compared by number and by time; kept as it is, not to be made faster.
"""

from __future__ import annotations

import math

import numpy as np
import pybullet
from numpy.typing import NDArray
from scipy import signal

from apex_bat.simulation.layout import Arena

SAMPLE_RATE_HZ = 125_000
NUM_SAMPLES = 3000
FREQUENCY_HZ = 40_000.0
SPEED_OF_SOUND_M_S = 343.0
POLE = 0.77836 * np.exp(2j * np.pi * FREQUENCY_HZ / SAMPLE_RATE_HZ)
LOW_PASS = signal.butter(2, 1000.0, fs=SAMPLE_RATE_HZ)
MAX_RANGE_M = 20.0
SENSOR_HEIGHT_M = 0.4
STEP_M, TURN_RAD = 0.15, math.radians(18.0)


class ObviousEnvironment:
    """One bat in one arena. `step` returns the frame (2, 24) and the clearance; close it."""

    def __init__(self, arena: Arena, pose: tuple[float, float, float]) -> None:
        """Builds PyBullet's bodies and puts the bat at x, y, heading."""
        self._client = pybullet.connect(pybullet.DIRECT)
        for x_m, y_m, yaw_rad, length_m, thickness_m, height_m in arena.walls:
            half = [length_m / 2, thickness_m / 2, height_m / 2]
            shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client)
            turn = pybullet.getQuaternionFromEuler([0.0, 0.0, yaw_rad])
            pybullet.createMultiBody(0, shape, -1, [x_m, y_m, height_m / 2], turn, physicsClientId=self._client)
        self._pose = np.array(pose)
        self._ahead = [
            (azimuth, elevation)
            for elevation in np.radians(np.linspace(0.0, 30.0, 10))
            for azimuth in np.radians(np.linspace(-90.0, 90.0, 100))
        ]
        self._around = [(azimuth, 0.0) for azimuth in np.radians(np.arange(360.0))]
        self._gain_db = directivity_db(np.array(self._ahead))
        self._call = call()

    def step(self, action: int) -> tuple[NDArray[np.float64], float]:
        """Flies 0.15 m straight (0), to the left (1) or to the right (2), and listens."""
        turn_rad = (0.0, TURN_RAD, -TURN_RAD)[action]
        middle_rad = self._pose[2] + turn_rad / 2
        chord_m = STEP_M * np.sinc(turn_rad / 2 / np.pi)
        self._pose += (chord_m * math.cos(middle_rad), chord_m * math.sin(middle_rad), turn_rad)
        range_m = self._ranges_m(self._ahead)
        clearance_m = float(self._ranges_m(self._around).min())
        return np.stack([self._hear(range_m, self._gain_db[ear]) for ear in range(2)]), clearance_m

    def close(self) -> None:
        """Ends the PyBullet client."""
        pybullet.disconnect(self._client)

    def _ranges_m(self, angles: list[tuple[float, float]]) -> NDArray[np.float64]:
        start = [self._pose[0], self._pose[1], SENSOR_HEIGHT_M]
        ends = [
            [
                start[0] + MAX_RANGE_M * math.cos(elevation) * math.cos(azimuth + self._pose[2]),
                start[1] + MAX_RANGE_M * math.cos(elevation) * math.sin(azimuth + self._pose[2]),
                start[2] + MAX_RANGE_M * math.sin(elevation),
            ]
            for azimuth, elevation in angles
        ]
        hits = pybullet.rayTestBatch([start] * len(ends), ends, numThreads=1, physicsClientId=self._client)
        return np.array([MAX_RANGE_M * hit[2] if hit[0] >= 0 else np.inf for hit in hits])

    def _hear(self, range_m: NDArray[np.float64], gain_db: NDArray[np.float64]) -> NDArray[np.float64]:
        is_hit = np.isfinite(range_m)
        r = range_m[is_hit]
        level_db = 100.0 + 40.0 * np.log10(0.1 / r) - 2.0 * 1.318 * r + gain_db[is_hit]
        pressure_pa = 2e-5 * 10.0 ** (level_db / 20.0)
        delay = np.round(2.0 * r / SPEED_OF_SOUND_M_S * SAMPLE_RATE_HZ).astype(int)
        is_heard = (level_db >= 20.0) & (delay < NUM_SAMPLES)
        taps = np.zeros(NUM_SAMPLES)
        np.add.at(taps, delay[is_heard], pressure_pa[is_heard])
        sound_pa = np.convolve(taps, self._call)[:NUM_SAMPLES].astype(complex)
        for _ in range(4):
            sound_pa = signal.lfilter([1.0 - abs(POLE)], [1.0, -POLE], sound_pa)
        compressed = np.maximum(2.0 * sound_pa.real, 0.0) ** 0.4
        envelope = np.maximum(signal.lfilter(*LOW_PASS, compressed), 0.0)
        return np.asarray(envelope.reshape(24, -1).mean(axis=1))


def call() -> NDArray[np.float64]:
    """Returns the call: 2.5 ms of 40 kHz with raised-cosine ramps."""
    sine = np.sin(2.0 * np.pi * FREQUENCY_HZ * np.arange(312) / SAMPLE_RATE_HZ)
    ramp = 0.5 * (1.0 - np.cos(np.pi * np.arange(31) / 31))
    sine[:31] *= ramp
    sine[-31:] *= ramp[::-1]
    return sine


def directivity_db(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns mouth and ears together in dB, (2, points), for azimuth and elevation (points, 2) in radians."""

    def cosine_to(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
        azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
        level = np.cos(angles[:, 1]) * math.cos(elevation) * np.cos(angles[:, 0] - azimuth)
        return np.asarray(level + np.sin(angles[:, 1]) * math.sin(elevation))

    mouth = 10.0 / math.log(10.0) * 4.0 * (cosine_to(0.0, -31.5) - 1.0)
    ears = [10.0 * np.log10(np.exp(7.4 * (cosine_to(side, 16.0) - 1.0)) + 10.0**-2.57) for side in (31.0, -31.0)]
    return np.stack([5.13 + mouth + ear for ear in ears])
