"""The scalar entities of a flight recording: which array of the flight each holds, its unit, and when it is true.

This table is what the recording is written from, read back by, and documented with (docs/recordings.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from apex_bat.recording.flight import ACTION_NAMES

Rgb = tuple[int, int, int]

# Okabe and Ito's palette: distinct for the colour-blind, visible on the dark and on the light theme.
GREEN: Rgb = (0, 158, 115)
BLUE: Rgb = (86, 180, 233)
ORANGE: Rgb = (230, 159, 0)
RED: Rgb = (213, 94, 0)
PURPLE: Rgb = (204, 121, 167)
GREY: Rgb = (140, 140, 140)

PROPERTIES_PATH = "__properties/flight"
"""Where a recording keeps what is known of the whole flight."""
SETTINGS_PATH = "settings"
"""Where a recording keeps its arena, robot and sonar as JSON."""

EAR_NAMES = ("left", "right")
EAR_COLOURS = (BLUE, ORANGE)
ACTION_COLOURS = (GREEN, BLUE, ORANGE)


@dataclass(frozen=True)
class Series:
    """One entity of one or several scalars a step."""

    path: str
    """Entity path."""
    field: str
    """The array of `Flight` that it holds."""
    names: tuple[str, ...]
    """What each scalar is, with its unit."""
    colours: tuple[Rgb, ...]
    """Colour of each line."""
    when: Literal["call", "result", "pose"]
    """`call`: row k stands at step k. `result`: at step k + 1, when the action of step k has acted.
    `pose`: at step k, and once more at the end of the flight."""
    marker: bool = False
    """Whether it is drawn as points, not as a line."""


SERIES = (
    Series("odometry/pose", "poses", ("x [m]", "y [m]", "heading [rad]"), (BLUE, ORANGE, GREY), "pose"),
    Series("policy/q", "q", tuple(f"Q {name}" for name in ACTION_NAMES), ACTION_COLOURS, "call"),
    Series("policy/chosen", "chosen_q", ("Q of the chosen action",), (PURPLE,), "call", marker=True),
    Series("policy/value", "value", ("V",), (PURPLE,), "call"),
    Series("policy/advantage", "advantage", tuple(f"A {name}" for name in ACTION_NAMES), ACTION_COLOURS, "call"),
    Series("reward/straight", "reward_straight", ("straight",), (GREEN,), "result"),
    Series("reward/near", "reward_near", ("near",), (RED,), "result"),
    Series("reward/step", "reward", ("reward",), (BLUE,), "result"),
    Series("reward/return", "returns", ("return",), (PURPLE,), "result"),
    Series("sensor/clearance", "clearance_m", ("clearance [m]",), (BLUE,), "result"),
    Series("odometry/progress", "progress_m", ("progress [m]",), (GREEN,), "result"),
    Series("odometry/distance", "distance_m", ("distance [m]",), (GREY,), "result"),
)
