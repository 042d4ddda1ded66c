"""Every setting of the simulation changes a flight: settings that do nothing are the commonest defect of this field."""

from typing import Any

import msgspec
import numpy as np
import pytest

from apex_bat.config.settings import Body, Episode, Rays, Sensing, Sonar
from apex_bat.simulation.vector import EchoFlightVector

FEW = Rays(num_azimuth=20, num_elevation=4, num_clearance=90)
"""Fewer rays, where the number does not matter."""
AT_WALL = np.array([[4.0, 0.0, 0.0], [3.811, 0.0, np.pi / 2]])
"""In simple: one bat that flies into the eastern wall, one that has a free corridor ahead."""
ELSEWHERE = {"caster": "test_rays", "safe_start_m": "test_starts", "evaluation_steps": "test_vector"}
"""Settings whose effect is tested in other files."""

CHANGES: dict[str, dict[str, Any]] = {
    "diameter_m": {"body": Body(diameter_m=0.6)},
    "speed_m_s": {"body": Body(speed_m_s=2.0)},
    "turn_rate_deg_s": {"body": Body(turn_rate_deg_s=200.0)},
    "call_interval_s": {"body": Body(call_interval_s=0.04)},
    "sensor_height_m": {"body": Body(sensor_height_m=0.6)},
    "heading_noise_deg": {"body": Body(heading_noise_deg=3.0)},
    "speed_noise": {"body": Body(speed_noise=0.1)},
    "num_azimuth": {"rays": Rays(num_azimuth=21, num_elevation=4, num_clearance=90)},
    "num_elevation": {"rays": Rays(num_azimuth=20, num_elevation=5, num_clearance=90)},
    "azimuth_span_deg": {"rays": Rays(num_azimuth=20, num_elevation=4, num_clearance=90, azimuth_span_deg=90.0)},
    "max_elevation_deg": {"rays": Rays(num_azimuth=20, num_elevation=4, num_clearance=90, max_elevation_deg=9.0)},
    "num_clearance": {"rays": Rays(num_azimuth=20, num_elevation=4, num_clearance=3)},
    "max_range_m": {"rays": Rays(num_azimuth=20, num_elevation=4, num_clearance=90, max_range_m=0.8)},
    "sonar": {"sonar": Sonar(call_level_db=90.0)},
    "memory_steps": {"sensing": Sensing(memory_steps=2)},
    "action_memory": {"sensing": Sensing(action_memory=False)},
    "onset": {"sensing": Sensing(onset="copy")},
    "onset_threshold": {"sensing": Sensing(onset_threshold=0.1)},
    "near_m": {"episode": Episode(near_m=0.7)},
    "near_reward": {"episode": Episode(near_reward=-0.1)},
    "straight_reward": {"episode": Episode(straight_reward=0.1)},
    "max_damage": {"episode": Episode(max_damage=1)},
    "max_idle": {"episode": Episode(max_idle=1)},
    "training_steps": {"episode": Episode(training_steps=2)},
}


def flight_of(**settings: Any) -> list[Any]:
    env = EchoFlightVector(2, **{"condition": "onset", "rays": FEW, "autoreset_mode": "Disabled", **settings})
    observation, _ = env.reset(seed=0, options={"poses": AT_WALL + np.array([0.05, 0.0, 0.3])})
    flight: list[Any] = [observation["echoes"].tolist()]
    for action in (0, 0, 1, 2, 0, 1):
        observation, reward, terminated, truncated, info = env.step(np.full(2, action))
        flight += [observation["echoes"].tolist(), observation["actions"].tolist(), reward.tolist()]
        flight += [terminated.tolist(), truncated.tolist(), info["x_m"].tolist(), info["clearance_m"].tolist()]
        if terminated.any() or truncated.any():
            break
    env.close()
    return flight


@pytest.mark.parametrize("setting", CHANGES)
def test_every_setting_changes_a_flight(setting: str) -> None:
    assert flight_of(**CHANGES[setting]) != flight_of()


def test_no_setting_is_forgotten() -> None:
    sections = (Body, Rays, Sensing, Episode)
    fields = {field.name for section in sections for field in msgspec.structs.fields(section)}
    assert fields == {*CHANGES, *ELSEWHERE} - {"sonar"}
