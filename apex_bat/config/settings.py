"""Every setting of the system: its type, default, unit, range and source.

One frozen class a part. The string under each field says what it is, in which unit, and where its default comes from:
"thesis" is Mohan & Vanderelst (2020), "Ape-X" is Horgan et al. (2018). Impossible combinations are refused when the
object is made. Derived numbers are properties, so that each number has one home.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from apex_bat.config.bat import Body, Episode, Rays, Sensing, Sonar
from apex_bat.config.learning import Actor, Exploration, Learner, Network, Replay
from apex_bat.config.running import Checkpoint, Cluster, Evaluation, Launch, Recording, Train, Transport
from apex_bat.config.sections import Condition, CountOrZero, Section

__all__ = [
    "Config",
    "Condition",
    "Body",
    "Rays",
    "Sonar",
    "Sensing",
    "Episode",
    "Network",
    "Learner",
    "Exploration",
    "Replay",
    "Actor",
    "Transport",
    "Train",
    "Checkpoint",
    "Evaluation",
    "Recording",
    "Launch",
    "Cluster",
]

MOST_ACTORS = 4096


class Config(Section, frozen=True):
    """All settings of a run."""

    seed: CountOrZero = 0
    """Every random stream of a run derives from this one seed."""
    arena: str = "simple"
    """Name of a shipped arena, a file under configs/arenas, or a path to one."""
    condition: Condition = "memory"
    """What the bat may use: three echoes, the newest only, or only the onsets of them (thesis)."""
    actors: Annotated[int, Meta(ge=1, le=MOST_ACTORS)] = 2
    """Actor processes. `auto`: as many as this machine has cores, less two, at least 1, or as the cluster has room for;
    in serial mode the default."""
    bats_per_actor: Annotated[int, Meta(ge=1, le=1024)] = 16
    """Bats that each actor flies in one world, in step."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the learner computes; auto: CUDA when there is one."""

    body: Body = Body()
    rays: Rays = Rays()
    sonar: Sonar = Sonar()
    sensing: Sensing = Sensing()
    episode: Episode = Episode()
    network: Network = Network()
    learner: Learner = Learner()
    exploration: Exploration = Exploration()
    replay: Replay = Replay()
    actor: Actor = Actor()
    transport: Transport = Transport()
    train: Train = Train()
    checkpoint: Checkpoint = Checkpoint()
    evaluation: Evaluation = Evaluation()
    recording: Recording = Recording()
    launch: Launch = Launch()
    cluster: Cluster = Cluster()

    def __post_init__(self) -> None:
        absent = [number for number in self.recording.actors if number >= self.actors]
        if absent:
            raise ValueError(
                f"recording.actors names actor {absent[0]}, and the {self.actors} actors have the numbers 0 to"
                f" {self.actors - 1}"
            )

    @property
    def largest_insert(self) -> int:
        """Transitions that an actor sends at once at most: a chunk of each bat, with n - 1 more where episodes end."""
        return (self.actor.chunk_transitions + self.learner.num_step) * self.bats_per_actor

    @property
    def state_steps(self) -> int:
        """Echo frames in a state: `sensing.memory_steps`."""
        return self.sensing.memory_steps

    @property
    def heard_steps(self) -> int:
        """Frames of a state that are not blanked: 1 in the condition no_memory, else all of them."""
        return 1 if self.condition == "no_memory" else self.sensing.memory_steps
