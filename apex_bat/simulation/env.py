"""One bat as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from apex_bat.config.settings import Body, Episode, Rays, Sensing, Sonar
from apex_bat.experience import NUM_ACTIONS
from apex_bat.simulation.colony import Colony
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.vector import RENDER_MODES, ArenaLike, Info, Observation, find_arenas, observation_space


class EchoFlight(gymnasium.Env[Observation, np.int64]):
    """An artificial bat that avoids walls by its echoes (Mohan & Vanderelst 2020).

    The robot, a cylinder of 0.35 m, flies at 3 m/s and calls every 50 ms, which is one step: 0.15 m. Its two ears hear
    the echoes of 1000 points ahead. Numbers are the defaults of the settings body, rays, sonar, sensing and episode.

    Observation (a Dict):

    | key     | space                    | content                                                       | unit        |
    |---------|--------------------------|---------------------------------------------------------------|-------------|
    | echoes  | Box float32 (6, 24)      | rows: left, right ear at t-2, t-1, t; columns: 1 ms or 17 cm  | Pa^0.4,     |
    |         |                          | of range each; zeros (silence) before the start               | about 0..1  |
    | actions | MultiDiscrete([3, 3, 3]) | a_{t-3}, a_{t-2}, a_{t-1}; 0 before the first                 | number      |

    In the condition `no_memory` the rows of t-2 and t-1 are zero; in `onset` each row keeps only its first value above
    the threshold; in `memory` all is there.

    Action (Discrete(3)):

    | action | meaning  | turn in a step |
    |--------|----------|----------------|
    | 0      | straight | 0 degrees      |
    | 1      | left     | +18 degrees    |
    | 2      | right    | -18 degrees    |

    Reward (eq. 3.2.2), by the clearance s after the step, the smallest of 360 ranges around, from the robot's middle:

    | term in info      | reward | when                   |
    |-------------------|--------|------------------------|
    | `reward_straight` | +0.050 | s > 0.4 m and straight |
    | `reward_near`     | -0.005 | s < 0.4 m              |

    Ends, named in `info["end"]`:

    | end       | kind        | when                                                      | in         |
    |-----------|-------------|-----------------------------------------------------------|------------|
    | `damage`  | termination | more than 3 steps of the episode had s < 0.4 m            | training   |
    | `idle`    | termination | more than 10 negative rewards since the last positive one | training   |
    | `contact` | termination | the robot touches a wall; in training it slides along it  | evaluation |
    | `time`    | truncation  | 300 steps; 1000 in evaluation                             | both       |

    Also in `info`: `clearance_m`; `distance_m`, the way flown; `progress_m`, the way along the corridor's middle,
    negative when clockwise, and `laps` of it (both 0 in an arena without a centre line); `contact`; `x_m`, `y_m` and
    `heading_rad`; `steps`; `arena_index`.

    A start is a random safe pose (apex_bat.simulation.starts), or `reset(options={"pose": (x, y, heading)})`.

    Version history: v0, the first.
    """

    def __init__(
        self,
        arena: ArenaLike = "simple",
        condition: str = "memory",
        *,
        body: Body | None = None,
        rays: Rays | None = None,
        sonar: Sonar | None = None,
        sensing: Sensing | None = None,
        episode: Episode | None = None,
        evaluation: bool = False,
        render_mode: str | None = None,
    ) -> None:
        """Builds the world; arguments and errors are those of `EchoFlightVector`."""
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode is {render_mode!r}; it must be None or one of {', '.join(RENDER_MODES)}")
        self.render_mode = render_mode
        self.observation_space = observation_space(sensing or Sensing())
        self.action_space = spaces.Discrete(NUM_ACTIONS)
        self.colony = Colony(
            1,
            find_arenas(arena, body, episode),
            condition,
            body=body,
            rays=rays,
            sonar=sonar,
            sensing=sensing,
            episode=episode,
            evaluation=evaluation,
            gui=render_mode == "human",
        )

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012 (Gymnasium's own annotation)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, Info]:
        """Starts an episode, at a random safe pose or at `options["pose"]`: x, y in metres, heading in radians."""
        super().reset(seed=seed)
        self.colony.generators[0] = self.np_random
        pose = (options or {}).get("pose")
        self.colony.begin(np.zeros(1, np.int64), None if pose is None else _checked_pose(pose))
        return self._observation(), self._info()

    def step(self, action: np.int64) -> tuple[Observation, float, bool, bool, Info]:
        """Flies one step of 50 ms."""
        if not self.action_space.contains(action):
            raise ValueError(f"the action is {action!r}; it must be 0 (straight), 1 (left) or 2 (right)")
        self.colony.step(np.array([action], np.int64))
        reward = float(self.colony.rewards.total[0])
        ends = bool(self.colony.terminated[0]), bool(self.colony.truncated[0])
        return self._observation(), reward, *ends, self._info()

    def render(self) -> NDArray[np.uint8] | None:
        """Returns a camera picture from above, uint8 (480, 640, 3), in the mode `rgb_array`; else None."""
        if self.render_mode != "rgb_array":
            return None
        return self.colony.world.picture(int(self.colony.arena_index[0]))

    def close(self) -> None:
        """Closes the world."""
        self.colony.close()

    @property
    def arena(self) -> Arena:
        """The arena of this episode."""
        return self.colony.arenas[int(self.colony.arena_index[0])]

    def _observation(self) -> Observation:
        return {key: values[0] for key, values in self.colony.observation().items()}

    def _info(self) -> Info:
        return {key: values[0].item() for key, values in self.colony.report().items()}


def _checked_pose(pose: object) -> NDArray[np.float64]:
    """Returns a start pose as float64 (1, 3)."""
    checked = np.asarray(pose, np.float64)
    if checked.shape != (3,) or not np.isfinite(checked).all():
        raise ValueError(f"options['pose'] is {pose!r}; it must be three finite numbers: x, y and heading")
    return checked[None]
