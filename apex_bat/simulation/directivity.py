"""How loud mouth and ears make an echo from each direction.

Axes are x forward, y left, z up; azimuth runs counter-clockwise (positive to the left) and elevation upwards; the axis
of ears has the order left, right. The default is a fit of this project to the measured Phyllostomus discolor at 40 kHz
(De Mey 2008, Vanderelst 2010): 2.42 dB RMS over azimuth +-90 and elevation 0 to 30 degrees.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.experience import NUM_EARS
from apex_bat.storage import read_npz

Floats = NDArray[np.float64]

_PISTON_FLOOR = 1e-3  # fills the nulls between the side lobes of a piston, -60 dB: no real ear is silent there


def directivity_db(sonar: settings.Sonar, azimuth_rad: Floats, elevation_rad: Floats) -> Floats:
    """Returns the level that mouth and ears together add in some directions.

    Args:
        sonar: its `directivity` and the settings that belong to it.
        azimuth_rad: (..., points).
        elevation_rad: (..., points).

    Returns:
        (..., 2, points) dB. The right ear is the mirror image of the left one, except in a user's table.

    Raises:
        ValueError: the table cannot be read, has the wrong shape or does not reach a direction.
    """
    if sonar.directivity == "table":
        return _table_db(sonar.directivity_table, azimuth_rad, elevation_rad)
    # One ear is computed and heard from mirrored directions, so that mirrored scenes give the same bits.
    left, right = (_left_ear_db(sonar, side * azimuth_rad, elevation_rad) for side in (1.0, -1.0))
    return np.stack((left, right), axis=-2)


def _left_ear_db(sonar: settings.Sonar, azimuth_rad: Floats, elevation_rad: Floats) -> Floats:
    """Returns the level (..., points) of the left ear for every directivity but the table."""
    if sonar.directivity == "omni":
        return np.zeros(np.broadcast_shapes(azimuth_rad.shape, elevation_rad.shape))
    if sonar.directivity == "piston":
        return _piston_db(sonar, _axis_cosine(azimuth_rad, elevation_rad, sonar.piston_angle_deg, 0.0))
    # Two von Mises beams: the mouth's points downwards, the ear's outwards and up, over a floor of -25.7 dB.
    mouth = _axis_cosine(azimuth_rad, elevation_rad, 0.0, -31.5)
    ear = _axis_cosine(azimuth_rad, elevation_rad, 31.0, 16.0)
    mouth_db = 10.0 * math.log10(math.e) * 4.0 * (mouth - 1.0)
    return np.asarray(5.13 + mouth_db + 10.0 * np.log10(np.exp(7.4 * (ear - 1.0)) + 10.0**-2.57))


def _axis_cosine(
    azimuth_rad: Floats, elevation_rad: Floats, axis_azimuth_deg: float, axis_elevation_deg: float
) -> Floats:
    """Returns the cosine of the angle between each direction and an axis."""
    axis_azimuth, axis_elevation = math.radians(axis_azimuth_deg), math.radians(axis_elevation_deg)
    level_part = np.cos(elevation_rad) * math.cos(axis_elevation) * np.cos(azimuth_rad - axis_azimuth)
    return np.asarray(np.sin(elevation_rad) * math.sin(axis_elevation) + level_part)


def _piston_db(sonar: settings.Sonar, cosine: Floats) -> Floats:
    """Returns 20 log10 |2 J1(x) / x|, x = k a sin angle: a piston in a baffle; farther back is as at its side."""
    from scipy.special import j1  # here, as below: the default needs neither, and both take a while to import

    sine = np.where(cosine > 0.0, np.sqrt(np.clip(1.0 - cosine**2, 0.0, 1.0)), 1.0)
    wavenumber = 2.0 * np.pi * sonar.frequency_hz / sonar.speed_of_sound_m_s
    x = np.maximum(wavenumber * sonar.piston_radius_m * sine, 1e-9)
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(2.0 * j1(x) / x), _PISTON_FLOOR)))


def _table_db(path: str, azimuth_rad: Floats, elevation_rad: Floats) -> Floats:
    """Returns the levels (..., 2, points) of a user's table, linear between its grid points."""
    from scipy.interpolate import RegularGridInterpolator

    table_azimuth, table_elevation, table_db = _read_table(path)
    directions = np.stack(np.broadcast_arrays(azimuth_rad, elevation_rad), axis=-1)
    for name, grid, given in zip(
        ("azimuth", "elevation"), (table_azimuth, table_elevation), np.moveaxis(directions, -1, 0), strict=True
    ):
        # Half a milliradian: a table and rays that end at the same rounded angle fit each other.
        if given.size and (given.min() < grid[0] - 5e-4 or given.max() > grid[-1] + 5e-4):
            raise ValueError(
                f"{path} covers {name} {grid[0]:.4f} to {grid[-1]:.4f} rad, "
                f"but {given.min():.4f} to {given.max():.4f} rad is needed"
            )
    directions = np.clip(directions, (table_azimuth[0], table_elevation[0]), (table_azimuth[-1], table_elevation[-1]))
    ears = (RegularGridInterpolator((table_azimuth, table_elevation), ear)(directions) for ear in table_db)
    return np.stack([np.asarray(ear, np.float64) for ear in ears], axis=-2)


def _read_table(path: str) -> tuple[Floats, Floats, Floats]:
    """Returns azimuth_rad (a,), elevation_rad (e,) and level_db (2, a, e) of an .npz file."""
    try:
        table = read_npz(Path(path))
        azimuth, elevation, level = (
            np.asarray(table[name], np.float64) for name in ("azimuth_rad", "elevation_rad", "level_db")
        )
    except (KeyError, ValueError) as error:
        raise ValueError(f"directivity_table {path!r} cannot be read: {error}") from error
    if azimuth.ndim != 1 or elevation.ndim != 1 or level.shape != (NUM_EARS, len(azimuth), len(elevation)):
        raise ValueError(
            f"directivity_table {path!r}: level_db has shape {level.shape}, "
            f"but needs {(NUM_EARS, len(azimuth), len(elevation))}: ears, azimuths, elevations"
        )
    is_finite = all(np.isfinite(array).all() for array in (azimuth, elevation, level))
    if not (is_finite and (np.diff(azimuth) > 0.0).all() and (np.diff(elevation) > 0.0).all()):
        raise ValueError(f"directivity_table {path!r}: angles must rise and levels must be finite")
    return azimuth, elevation, level
