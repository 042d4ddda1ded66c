"""Settings of a run: addresses, limits, checkpoints, evaluation, recording, restarts."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from apex_bat.config.sections import Count, CountOrZero, NonNegative, Positive, Section


class Transport(Section, frozen=True):
    """Where the roles listen (see apex_bat.transport)."""

    host: str = "ipc"
    """`ipc`: sockets in a private folder (POSIX). Else the address that servers bind; not loopback: needs `keys`."""
    base_port: Annotated[int, Meta(ge=0, le=65_000)] = 0
    """First of the consecutive TCP ports; 0: any free ones."""
    keys: str = ""
    """Folder of CURVE keys made by `apex-bat keys`."""
    max_message_mb: Annotated[float, Meta(gt=0.0, le=1024.0)] = 64.0
    """A larger message is refused."""

    @property
    def max_message_bytes(self) -> int:
        """`max_message_mb` in bytes (of 2^20 a MB)."""
        return int(self.max_message_mb * 2**20)


class Train(Section, frozen=True):
    """When training ends."""

    max_minutes: Positive | None = 12.0
    """Wall-clock limit, from the first environment step."""
    max_env_steps: Count | None = None
    """Limit in environment steps over all bats."""
    max_updates: Count | None = None
    """Limit in learner updates."""
    threads: Count = 1
    """Threads that torch uses in the learner on a CPU."""

    def __post_init__(self) -> None:
        if self.max_minutes is None and self.max_env_steps is None and self.max_updates is None:
            raise ValueError("set at least one of max_minutes, max_env_steps and max_updates, or training never ends")


class Checkpoint(Section, frozen=True):
    """Checkpoints of the learner."""

    period_s: Positive = 30.0
    """Seconds between checkpoints."""
    keep: Count = 5
    """Newest checkpoints kept, beside the best one."""


class Evaluation(Section, frozen=True):
    """Greedy flights that judge a policy."""

    flights: Count = 15
    """Flights in each arena (thesis: 15)."""
    arenas: tuple[str, ...] = ("simple",)
    """Arenas flown after training."""
    start_seed: CountOrZero = 20_200
    """Seed of the start poses: the same for every policy and condition."""
    during_training: bool = True
    """Whether an evaluator judges new checkpoints while training runs."""
    period_s: Positive = 60.0
    """Seconds between the starts of two evaluations during training."""


class Recording(Section, frozen=True):
    """What is written to rerun recordings."""

    evaluation_flights: CountOrZero = 3
    """Flights recorded of the evaluation after training, in each arena: the first so many. 0: nothing of it."""
    extremes: bool = True
    """Whether the best and the worst of those flights are recorded besides, marked in their names."""
    crashes: CountOrZero = 2
    """How many further flights of each arena that ended at a wall are recorded besides, those that flew longest
    before it, marked in their names."""
    sampled_flights: CountOrZero = 1
    """Flights recorded of each evaluation during training."""
    every_episodes: CountOrZero = 20
    """The actors below record every n-th episode of their least exploring bat, the first
    one being the n-th; 0: none."""
    actors: tuple[CountOrZero, ...] = (0,)
    """Numbers of the actors that record."""
    heavy_period_steps: Count = 5
    """Points, the stages of the ear and cochleagrams are written at every n-th step; poses and values at each."""
    curves: bool = True
    """Whether the course of the training is recorded too, in recordings/training.rrd."""
    max_mb: Positive = 500.0
    """Recordings go when they exceed this together: training before evaluation, marked ones last, the oldest first."""


class Launch(Section, frozen=True):
    """How roles are watched and restarted."""

    backoff_s: Positive = 0.2
    """Wait before the first restart of a role; doubles with each quick failure, up to 30 s."""
    max_failures: CountOrZero = 5
    """Quick failures in a row after which a role is given up and the run ends."""
    quick_failure_s: Positive = 20.0
    """A failure is quick when the role lived shorter than this. It works after 3 to 8 s (measured on two cores)."""
    learner_in_reserve: bool = True
    """Whether a process that has imported torch waits to take the place of a learner that dies. It takes 250 MB."""
    start_timeout_s: Positive = 120.0
    """A new process that has not been heard of for this long is killed and replaced; importing torch takes seconds."""
    heartbeat_timeout_s: Positive = 30.0
    """A role that was heard and then not for this long is killed and replaced; each reports every second."""
    grace_s: Positive = 8.0
    """How long a role may take to end after it was asked to, or after the launcher was killed (1 s on a cluster)."""
    stall_s: Positive = 60.0
    """Time without an environment step or an update after which view, status and log say so, and who waits for whom."""
    dense_rows_s: Positive = 3600.0
    """So long each role's metrics get a row a second; then the period grows as elapsed / this, to bound the files."""
    log_max_mb: Positive = 10.0
    """Size at which a log is renamed to NAME.log.1 and begun anew (POSIX; elsewhere logs grow)."""
    log_files: CountOrZero = 3
    """Former logs kept of each role; 0: none, and the log is emptied instead."""


class Cluster(Section, frozen=True):
    """Where Ray puts the roles of `train --cluster`, and how long they live without their launcher."""

    role_cpus: Positive = 1.0
    """CPUs set aside for each actor, for the replay and for the evaluator. The learner takes `train.threads`."""
    learner_gpus: NonNegative | None = None
    """GPUs set aside for the learner; None: one if the cluster has any and `device` is not cpu."""
    replay_memory_gb: Positive | None = None
    """Memory set aside for each replay server, of 1e9 bytes; None: 0.5 and 600 bytes for each transition that it holds
    (280 measured, twice that while a snapshot is written)."""
    learner_resource: str = ""
    """Custom resource (`ray start --resources`) of which the learner takes 1, to be put where there is one."""
    replay_resource: str = ""
    """The same for the replay."""
    actor_resource: str = ""
    """The same for each actor."""
    grow: bool = False
    """Whether further actors are started when the cluster has room for more. `actors = "auto"` sets it there."""
    wait_s: Positive = 120.0
    """How long to wait at the start for a place for replay, learner, evaluator and one actor; then the run fails."""
    lease_s: Annotated[float, Meta(ge=2.0)] = 20.0
    """A role whose host has not heard the launcher for so long is killed there, and replaced elsewhere afterwards: less
    than the 65 s in which Ray notices a silent node, more than the pauses of a network that is well."""
