"""Every setting of the simulation changes what is measured: settings that do nothing are this field's commonest defect.

The cases are matched with the fields of the settings classes, so that a field that is added without one fails.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from apex_bat.config.sections import Section
from apex_bat.config.settings import Body, Episode, Rays, Sensing, Sonar
from apex_bat.simulation.vector import EchoFlightVector

SECTIONS: dict[str, type[Section]] = {
    "body": Body,
    "rays": Rays,
    "sonar": Sonar,
    "sensing": Sensing,
    "episode": Episode,
}
SETTINGS = [f"{name}.{field.name}" for name, section in SECTIONS.items() for field in msgspec.structs.fields(section)]
FEW_RAYS: dict[str, Any] = {"num_azimuth": 20, "num_elevation": 4, "num_clearance": 90}
AT_WALLS = np.array([[4.05, 0.0, 0.3], [3.861, 0.0, np.pi / 2 + 0.3]])
"""In simple: one bat that flies into the eastern wall, one that has a free corridor ahead."""


class Case(NamedTuple):
    """Another value of a setting, and what must be set beside it, in both flights, for it to matter."""

    value: Any
    beside: Mapping[str, Any] = MappingProxyType({})
    """Other settings of the same section; the setting's own entry replaces its default."""
    world: Mapping[str, Any] = MappingProxyType({})
    """Arguments of the environment."""


ISO = {"absorption_db_m": None, "temperature_c": 20.0, "humidity_percent": 50.0}
PISTON = {"directivity": "piston"}
CASES = {
    "body.diameter_m": Case(0.6),
    "body.speed_m_s": Case(2.0),
    "body.turn_rate_deg_s": Case(200.0),
    "body.call_interval_s": Case(0.04),
    "body.sensor_height_m": Case(0.6),
    "body.heading_noise_deg": Case(3.0),
    "body.speed_noise": Case(0.1),
    "rays.caster": Case("pybullet"),
    "rays.num_azimuth": Case(21),
    "rays.num_elevation": Case(5),
    "rays.azimuth_span_deg": Case(90.0),
    "rays.max_elevation_deg": Case(9.0),
    "rays.num_clearance": Case(3),
    "rays.max_range_m": Case(0.8),
    "sonar.rendering": Case("exact"),
    "sonar.call_level_db": Case(90.0),
    "sonar.call_duration_s": Case(0.002),
    "sonar.call_ramp_samples": Case(10),
    "sonar.frequency_hz": Case(45_000.0),
    "sonar.sweep_hz": Case(5_000.0),
    "sonar.absorption_db_m": Case(2.0),
    "sonar.temperature_c": Case(30.0, ISO),
    "sonar.humidity_percent": Case(20.0, ISO),
    "sonar.speed_of_sound_m_s": Case(340.0),
    "sonar.floor_db": Case(60.0),
    "sonar.summation": Case("incoherent"),
    "sonar.level_jitter_db": Case(2.0),
    "sonar.receiver_noise_db": Case(40.0),
    "sonar.directivity": Case("omni"),
    "sonar.directivity_table": Case(
        "{folder}/quiet.npz", {"directivity": "table", "directivity_table": "{folder}/loud.npz"}
    ),
    "sonar.piston_radius_m": Case(0.008, PISTON),
    "sonar.piston_angle_deg": Case(10.0, PISTON),
    "sonar.ear_separation_m": Case(0.05),
    "sensing.memory_steps": Case(2),
    "sensing.onset": Case("copy"),
    "sensing.onset_threshold": Case(0.1),
    "sensing.action_memory": Case(False),
    "episode.near_m": Case(0.7),
    "episode.near_reward": Case(-0.1),
    "episode.straight_reward": Case(0.1),
    "episode.max_damage": Case(1),
    "episode.max_idle": Case(1),
    "episode.training_steps": Case(2),
    "episode.evaluation_steps": Case(2, world={"evaluation": True}),
    "episode.safe_start_m": Case(0.6),
    "episode.listening_steps": Case(0),
}


def flight_of(section: str, settings: dict[str, Any], **world: Any) -> list[Any]:
    """Returns all that an agent, or a reader of results, gets to know of a flight of a few steps."""
    sections: dict[str, Any] = {"rays": Rays(**FEW_RAYS), section: msgspec.convert(settings, SECTIONS[section])}
    env = EchoFlightVector(2, condition="onset", autoreset_mode="Disabled", **sections, **world)
    _, info = env.reset(seed=0)
    flight: list[Any] = [info["x_m"].tolist()]
    observation, _ = env.reset(seed=0, options={"poses": AT_WALLS})
    flight.append(observation["echoes"].tolist())
    for action in (0, 0, 1, 2, 0, 1):
        observation, reward, terminated, truncated, info = env.step(np.full(2, action))
        flight += [observation["echoes"].tolist(), observation["actions"].tolist(), reward.tolist()]
        flight += [terminated.tolist(), truncated.tolist(), info["x_m"].tolist(), info["clearance_m"].tolist()]
        if terminated.any() or truncated.any():
            break
    env.close()
    return flight


@cache
def default_flight() -> list[Any]:
    return flight_of("rays", FEW_RAYS)


def write_tables(folder: Path) -> None:
    """Writes two tables of a directivity that is the same all around."""
    azimuth_rad, elevation_rad = np.linspace(-np.pi, np.pi, 5), np.linspace(-1.5, 1.5, 3)
    for name, level_db in (("loud", 0.0), ("quiet", -10.0)):
        table = np.full((2, 5, 3), level_db)
        np.savez(folder / f"{name}.npz", azimuth_rad=azimuth_rad, elevation_rad=elevation_rad, level_db=table)


@pytest.mark.parametrize("setting", SETTINGS)
def test_setting_changes_a_flight(setting: str, tmp_path: Path) -> None:
    assert setting in CASES, f"{setting} was added; give it a case here that shows what it does"
    case, (section, field) = CASES[setting], setting.split(".")
    write_tables(tmp_path)
    without = {**(FEW_RAYS if section == "rays" else {}), **case.beside}
    without, changed = (
        {key: value.format(folder=tmp_path) if isinstance(value, str) else value for key, value in given.items()}
        for given in (without, without | {field: case.value})
    )
    is_default = not case.beside and not case.world
    before = default_flight() if is_default else flight_of(section, without, **case.world)
    assert flight_of(section, changed, **case.world) != before


def test_every_case_belongs_to_a_setting() -> None:
    assert set(CASES) <= set(SETTINGS)


def test_equal_settings_give_equal_flights() -> None:
    assert flight_of("body", {}) == default_flight()
