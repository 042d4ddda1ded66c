"""The ear for people: one call heard from any points, with every stage of thesis fig. 3.6 to look at.

>>> import numpy as np
>>> echo = Sonar().hear(azimuth_rad=np.array([0.0]), elevation_rad=np.array([0.0]), range_m=np.array([1.0]))
>>> echo.level_db.round(1).tolist()
[[54.3], [54.3]]
>>> echo.frame.shape
(2, 24)
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_bat.config import settings
from apex_bat.simulation import acoustics
from apex_bat.simulation.directivity import directivity_db
from apex_bat.simulation.echo import Echo
from apex_bat.simulation.listener import Listener
from apex_bat.simulation.receiver import LISTENING_S, receiver

Floats = NDArray[np.float64]

__all__ = ["Echo", "Listener", "Sonar"]


class Sonar:
    """The sonar of a bat: its call, the air, its ears and cochleae."""

    def __init__(self, sonar: settings.Sonar | None = None, **changes: Any) -> None:
        """Takes settings, and single ones to change: `Sonar(rendering="exact", call_level_db=95)`."""
        base = settings.Sonar() if sonar is None else sonar
        given = {name: value.item() if isinstance(value, np.generic) else value for name, value in changes.items()}
        self.settings = msgspec.convert(msgspec.structs.asdict(base) | given, settings.Sonar)
        self._receiver = receiver(self.settings)

    def listener(self, azimuth_rad: ArrayLike, elevation_rad: ArrayLike) -> Listener:
        """Returns the fast ear for rays of fixed directions, (points,) each."""
        azimuth, elevation = (np.asarray(angle, np.float64) for angle in (azimuth_rad, elevation_rad))
        _check_angles(azimuth, elevation)
        if azimuth.ndim != 1:
            raise ValueError(f"azimuth_rad has shape {azimuth.shape}; a listener takes (points,)")
        return Listener(self.settings, azimuth, elevation)

    def hear(
        self,
        azimuth_rad: ArrayLike,
        elevation_rad: ArrayLike,
        range_m: ArrayLike,
        generator: np.random.Generator | None = None,
    ) -> Echo:
        """Returns the echo of one call from some points, for one bat or several.

        Args:
            azimuth_rad: (points,) or (bats, points), counter-clockwise from straight ahead.
            elevation_rad: the same shape, upwards.
            range_m: the same shape, greater than 0; inf is a miss.
            generator: needed only where a setting is random; bats draw from it one after another.

        Raises:
            ValueError: which argument has which wrong value or shape.
        """
        azimuth, elevation, reach = (np.asarray(given, np.float64) for given in (azimuth_rad, elevation_rad, range_m))
        _check_angles(azimuth, elevation)
        _check_ranges(azimuth, reach)
        sonar, bats, num_points = self.settings, reach.shape[:-1], reach.shape[-1]
        generators = [generator] * (bats[0] if bats else 1)
        drawn = acoustics.draw_chance(sonar, generators, num_points, self._receiver.num_samples)
        chance = drawn if bats else acoustics.Chance(*(None if part is None else part[0] for part in drawn))
        path_m = acoustics.path_range_m(sonar, azimuth, elevation, reach)
        level_db = acoustics.level_db(sonar, path_m, directivity_db(sonar, azimuth, elevation))
        if chance.jitter_db is not None:
            level_db = level_db + chance.jitter_db
        pressure_pa = np.where(level_db >= sonar.floor_db, acoustics.pressure_pa(level_db), 0.0)
        delay_s = np.minimum(path_m * (2.0 / sonar.speed_of_sound_m_s), LISTENING_S)
        arrivals = acoustics.arrivals(sonar, pressure_pa, delay_s, chance)
        noise_pa = None if chance.noise is None else self._receiver.noise_pa * chance.noise
        return Echo(sonar, self._receiver, level_db, arrivals, delay_s, noise_pa)


def _check_angles(azimuth_rad: Floats, elevation_rad: Floats) -> None:
    """Raises ValueError unless both are finite and of one shape, (points,) or (bats, points)."""
    if azimuth_rad.shape != elevation_rad.shape:
        raise ValueError(
            f"azimuth_rad has shape {azimuth_rad.shape} and elevation_rad {elevation_rad.shape}; they must be equal"
        )
    if azimuth_rad.ndim not in (1, 2):
        raise ValueError(f"azimuth_rad has shape {azimuth_rad.shape}; (points,) or (bats, points) is allowed")
    for name, angle in (("azimuth_rad", azimuth_rad), ("elevation_rad", elevation_rad)):
        if not np.isfinite(angle).all():
            raise ValueError(f"{name} must be finite; it has NaN or inf")


def _check_ranges(azimuth_rad: Floats, range_m: Floats) -> None:
    """Raises ValueError unless the ranges fit the angles and are greater than 0."""
    if range_m.shape != azimuth_rad.shape:
        raise ValueError(f"range_m has shape {range_m.shape} and azimuth_rad {azimuth_rad.shape}; they must be equal")
    if np.isnan(range_m).any():
        raise ValueError("range_m has NaN; a miss is inf")
    if (range_m <= 0.0).any():
        raise ValueError(f"range_m must be greater than 0 (inf is a miss); its least value is {range_m.min()}")
