"""The fit, the piston and a user's table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import settings
from apex_bat.simulation.directivity import directivity_db

THESIS = settings.Sonar()

# Levels measured on the left side of Phyllostomus discolor: azimuth, elevation (degrees), level (dB).
MEASURED = [
    (0, 0, -3.8), (10, 0, -1.9), (30, 0, -0.1), (60, 0, -7.7), (90, 0, -22.7), (-10, 0, -6.7), (-30, 0, -18.3),
    (-60, 0, -29.4), (0, 15, -6.0), (30, 15, -2.2), (-30, 15, -16.5), (0, 30, -7.8), (30, 30, -7.1), (-30, 30, -15.5),
    (60, 30, -16.3), (-60, 30, -27.7),
]  # fmt: skip
MEASURED_DIFFERENCE = {10: 4.9, 20: 10.7, 30: 18.2, 40: 28.4, 60: 21.8}  # left minus right at elevation 0


def ears_db(sonar: settings.Sonar, azimuth_deg: float, elevation_deg: float = 0.0) -> tuple[float, float]:
    left, right = directivity_db(sonar, np.radians([azimuth_deg]), np.radians([elevation_deg]))[:, 0].tolist()
    return left, right


def direction(azimuth_rad: np.ndarray | float, elevation_rad: np.ndarray | float) -> np.ndarray:
    azimuth, elevation = np.asarray(azimuth_rad), np.asarray(elevation_rad)
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def test_fit_is_the_stated_formula() -> None:
    generator = np.random.default_rng(6)
    azimuth, elevation = generator.uniform(-3.1, 3.1, 200), generator.uniform(-1.5, 1.5, 200)
    towards = direction(azimuth, elevation)
    mouth = np.exp(4.0 * (direction(0.0, np.radians(-31.5)) @ towards - 1.0))
    left, right = directivity_db(THESIS, azimuth, elevation)
    for level_db, side in ((left, 1.0), (right, -1.0)):
        ear = np.exp(7.4 * (direction(side * np.radians(31.0), np.radians(16.0)) @ towards - 1.0)) + 10.0**-2.57
        np.testing.assert_allclose(level_db, 5.13 + 10.0 * np.log10(mouth * ear), atol=1e-9)


def test_fit_is_as_near_to_the_measured_levels_as_stated() -> None:
    measured_db = np.array([level_db for _, _, level_db in MEASURED])
    misfit_db = np.array([ears_db(THESIS, azimuth, elevation)[0] for azimuth, elevation, _ in MEASURED]) - measured_db
    assert np.sqrt(np.square(misfit_db).mean()) < 2.42 * 1.1  # stated for the whole field, of which these are 16
    assert np.sqrt(np.square(misfit_db[measured_db > -20.0]).mean()) < 1.42 * 1.3
    assert np.abs(misfit_db).max() < 9.6


def test_fit_has_the_measured_difference_between_the_ears() -> None:
    for azimuth_deg, measured_db in MEASURED_DIFFERENCE.items():
        left, right = ears_db(THESIS, azimuth_deg)
        assert left - right == pytest.approx(measured_db, abs=0.6 if azimuth_deg <= 20 else 9.6)


@pytest.mark.parametrize("kind", ["phyllostomus", "piston", "omni"])
def test_mirrored_directions_swap_the_ears_to_the_bit(kind: str) -> None:
    generator = np.random.default_rng(5)
    azimuth, elevation = generator.uniform(-3.1, 3.1, 333), generator.uniform(-1.5, 1.5, 333)
    sonar = settings.Sonar(directivity=kind)  # type: ignore[arg-type]
    ears, mirrored = directivity_db(sonar, azimuth, elevation), directivity_db(sonar, -azimuth, elevation)
    np.testing.assert_array_equal(ears, mirrored[::-1])


@pytest.mark.parametrize(("radius_mm", "half_angle_deg"), [(4, 49), (5, 37), (6, 30), (8, 22)])
def test_piston_is_6_db_down_at_its_half_angle(radius_mm: int, half_angle_deg: int) -> None:
    sonar = settings.Sonar(directivity="piston", piston_radius_m=radius_mm / 1000, piston_angle_deg=0.0)
    angle_deg = np.arange(0.0, 90.0, 0.01)
    level_db = directivity_db(sonar, np.radians(angle_deg), np.zeros(len(angle_deg)))[0]
    assert level_db[0] == pytest.approx(0.0, abs=1e-6)
    assert angle_deg[np.argmax(level_db < 20.0 * np.log10(0.5))] == pytest.approx(half_angle_deg, abs=0.6)


def test_piston_points_outwards_by_its_angle() -> None:
    sonar = settings.Sonar(directivity="piston", piston_angle_deg=40.0)
    assert ears_db(sonar, 40.0)[0] == pytest.approx(0.0, abs=1e-6)
    assert ears_db(sonar, -40.0)[1] == pytest.approx(0.0, abs=1e-6)


def test_omni_hears_the_same_everywhere() -> None:
    assert ears_db(settings.Sonar(directivity="omni"), 77.0, 20.0) == (0.0, 0.0)


def write_table(path: Path, level_db: np.ndarray) -> settings.Sonar:
    np.savez(path, azimuth_rad=[-1.6, 0.0, 1.6], elevation_rad=[0.0, 0.6], level_db=level_db)
    return settings.Sonar(directivity="table", directivity_table=str(path))


def test_table_is_read_from_its_file_and_interpolated(tmp_path: Path) -> None:
    level_db = np.arange(12.0).reshape(2, 3, 2)
    sonar = write_table(tmp_path / "ears.npz", level_db)
    heard = directivity_db(sonar, np.array([-1.6, 0.0, 0.8]), np.array([0.0, 0.6, 0.3]))
    np.testing.assert_allclose(heard[0], [0.0, 3.0, 3.5])
    np.testing.assert_allclose(heard[1], [6.0, 9.0, 9.5])


def test_table_that_does_not_reach_a_direction_is_refused(tmp_path: Path) -> None:
    sonar = write_table(tmp_path / "ears.npz", np.zeros((2, 3, 2)))
    with pytest.raises(ValueError, match="elevation"):
        directivity_db(sonar, np.array([0.0]), np.array([0.7]))


def test_table_of_the_wrong_shape_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"needs \(2, 3, 2\)"):
        directivity_db(write_table(tmp_path / "ears.npz", np.zeros((3, 2))), np.zeros(1), np.zeros(1))


def test_missing_table_is_named(tmp_path: Path) -> None:
    sonar = settings.Sonar(directivity="table", directivity_table=str(tmp_path / "none.npz"))
    with pytest.raises(ValueError, match=r"none\.npz"):
        directivity_db(sonar, np.zeros(1), np.zeros(1))
