"""Every setting of the system: its type, default, unit, range and source.

One frozen class a part. The string under each field says what it is, in which unit, and where its default comes from:
"thesis" is Mohan & Vanderelst (2020), "Ape-X" is Horgan et al. (2018). Impossible combinations are refused when the
object is made. Derived numbers are properties, so that each number has one home.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta, Struct

Condition = Literal["memory", "no_memory", "onset"]

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Count = Annotated[int, Meta(ge=1)]
CountOrZero = Annotated[int, Meta(ge=0)]


class Section(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration file; unknown keys are refused."""


class Body(Section, frozen=True):
    """The robot and how it moves (thesis ch. 3)."""

    diameter_m: Positive = 0.35
    """Diameter of the cylinder, a kobuki turtlebot."""
    speed_m_s: Positive = 3.0
    """Constant forward speed."""
    turn_rate_deg_s: Positive = 360.0
    """Turn rate of the actions left and right."""
    call_interval_s: Positive = 0.05
    """Time between two calls, which is one step: 20 Hz."""
    sensor_height_m: Positive = 0.4
    """Height of mouth, ears and range sensors above the floor."""
    heading_noise_deg: NonNegative = 0.0
    """Standard deviation of a random turn added at each step. 0 in the thesis."""
    speed_noise: NonNegative = 0.0
    """Standard deviation of the relative error of the speed at each step. 0 in the thesis."""


class Rays(Section, frozen=True):
    """The range sensors. The 3D one feeds the ear, the 2D one the reward (thesis section 3.1)."""

    caster: Literal["embree", "pybullet"] = "embree"
    """Who intersects rays with the bodies: Embree on their meshes, or PyBullet itself (slower)."""
    num_azimuth: Count = 100
    """Columns of the 3D sensor, spread evenly over the azimuth span."""
    num_elevation: Count = 10
    """Rows of the 3D sensor, spread evenly over the elevation span; 100 x 10 = the thesis's 1000 rays."""
    azimuth_span_deg: Annotated[float, Meta(gt=0.0, le=360.0)] = 180.0
    """Width of the 3D sensor, centred ahead: -90 to +90 degrees."""
    max_elevation_deg: Annotated[float, Meta(ge=0.0, lt=90.0)] = 30.0
    """The 3D sensor looks from 0 up to this elevation, so that the floor returns no echoes."""
    num_clearance: Count = 360
    """Rays of the 2D sensor, evenly around the robot."""
    max_range_m: Positive = 20.0
    """Farther than this is a miss."""


class Sonar(Section, frozen=True):
    """The call, the air, the reflectors and the ears (thesis section 3.1, eq. 3.1.1)."""

    sample_rate_hz: ClassVar[int] = 125_000
    """Sample rate of the thesis's chain; the frame's 24 ms are 3000 samples of it. Not a setting."""

    rendering: Literal["thesis", "exact"] = "thesis"
    """`thesis`: 125 kHz chain with rounded delays. `exact`: complex baseband with exact delays, cheaper."""
    call_level_db: float = 100.0
    """Level of the call, dB SPL at 0.1 m (thesis eq. 3.1.1)."""
    call_duration_s: Annotated[float, Meta(gt=0.0, le=0.01)] = 0.0025
    """Length of the call (thesis)."""
    call_ramp_samples: CountOrZero = 31
    """Length of the raised-cosine ramps at both ends, in samples of 125 kHz."""
    frequency_hz: Annotated[float, Meta(ge=20_000.0, le=60_000.0)] = 40_000.0
    """Carrier or centre of the sweep, and the cochlea's channel that the frame comes from (thesis)."""
    sweep_hz: float = 0.0
    """Linear FM: the carrier runs over this band, from high to low when negative. 0 is the thesis's tone."""
    absorption_db_m: NonNegative | None = 1.318
    """One-way absorption of air (thesis: 40 kHz, 20 C, 50 % humidity). None: by ISO 9613-1 from the next two."""
    temperature_c: Annotated[float, Meta(ge=-20.0, le=50.0)] | None = None
    """Air temperature for ISO 9613-1; set it together with `humidity_percent` and with `absorption_db_m` None."""
    humidity_percent: Annotated[float, Meta(gt=0.0, le=100.0)] | None = None
    """Relative humidity for ISO 9613-1."""
    speed_of_sound_m_s: Positive = 343.0
    """Speed of sound (thesis)."""
    floor_db: float = 20.0
    """Reflectors below this level at the ear are not heard (thesis)."""
    summation: Literal["coherent", "random_phase", "incoherent"] = "coherent"
    """How echoes of one call add: as pressures (thesis), with a random phase each, or as energies."""
    level_jitter_db: NonNegative = 0.0
    """Standard deviation of a random level added to each reflector at each call. 0 in the thesis."""
    receiver_noise_db: float | None = None
    """White noise at each ear, as loud within the cochlea's channel as a tone of this level, dB SPL. None: no noise
    (thesis)."""
    directivity: Literal["phyllostomus", "piston", "table", "omni"] = "phyllostomus"
    """Mouth and ears together: the fit to Phyllostomus discolor at 40 kHz, a circular piston,
    a user's table, or the same level from everywhere."""
    directivity_table: str = ""
    """For `table`: an .npz with azimuth_rad (a,), elevation_rad (e,), level_db (2, a, e), ears left, right."""
    piston_radius_m: Positive = 0.005
    """For `piston`: its radius; 4, 5, 6, 8 mm give -6 dB half-angles of 49, 37, 30, 22 degrees at 40 kHz."""
    piston_angle_deg: Annotated[float, Meta(ge=0.0, le=90.0)] = 31.0
    """For `piston`: how far each ear points outwards."""
    ear_separation_m: NonNegative = 0.0
    """Distance between the ears; each hears its own path length. 0 in the thesis."""

    def __post_init__(self) -> None:
        iso = (self.temperature_c is not None, self.humidity_percent is not None)
        if self.absorption_db_m is None and not all(iso):
            raise ValueError("absorption_db_m is None, so temperature_c and humidity_percent must both be set")
        if self.absorption_db_m is not None and any(iso):
            raise ValueError("temperature_c and humidity_percent do nothing unless absorption_db_m is None")
        if (self.directivity == "table") != bool(self.directivity_table):
            raise ValueError('directivity_table and directivity = "table" belong together')
        if 2 * self.call_ramp_samples > self.call_duration_s * self.sample_rate_hz:
            raise ValueError(
                f"two ramps of {self.call_ramp_samples} samples are longer than a call of {self.call_duration_s} s"
            )
        if abs(self.sweep_hz) >= 2.0 * self.frequency_hz:
            raise ValueError(f"a sweep of {self.sweep_hz} Hz about {self.frequency_hz} Hz passes through zero")

    @property
    def is_random(self) -> bool:
        """Whether equal calls sound different: then each bat needs a random generator."""
        return self.level_jitter_db > 0.0 or self.summation == "random_phase" or self.receiver_noise_db is not None


class Sensing(Section, frozen=True):
    """How echoes become the state that the policy sees (thesis section 3.2)."""

    memory_steps: Annotated[int, Meta(ge=1, le=8)] = 3
    """Echoes in a state, the newest included: its rows are 2 x this (thesis: 3)."""
    onset: Literal["zero", "copy"] = "zero"
    """Condition onset: what stands after the first value above the floor: zeros, or that value (fig. 3.11)."""
    onset_threshold: Positive = 0.0131
    """A cochlea value counts as an onset above this: the greatest value of a 20 dB echo (measured)."""
    action_memory: bool = True
    """Whether the last three actions are part of the state (thesis eq. 3.2.1)."""


class Episode(Section, frozen=True):
    """Reward, counters and ends of an episode (thesis eq. 3.2.2)."""

    near_m: Positive = 0.4
    """Clearance below which a step is damage."""
    near_reward: float = -0.005
    """Reward of a step nearer than `near_m`."""
    straight_reward: float = 0.05
    """Reward of a straight step farther than `near_m`."""
    max_damage: CountOrZero = 3
    """The training episode terminates when more steps than this were near."""
    max_idle: CountOrZero = 10
    """It also terminates when there were more negative rewards than this since the last positive one."""
    training_steps: Count = 300
    """Time limit in training, a truncation."""
    evaluation_steps: Count = 1000
    """Time limit in evaluation: 150 m."""
    safe_start_m: Positive = 0.4
    """Least clearance of a start pose; a way out must exist too."""


class Network(Section, frozen=True):
    """The dueling network (thesis fig. 3.8: (1, 3) filters, so that each echo row is filtered by itself)."""

    channels: tuple[Count, ...] = (16, 32)
    """Filters of each convolution. The thesis gives no number."""
    strides: tuple[Count, ...] = (2, 2)
    """Stride of each convolution along the echo row. The thesis has 1; 2 is several times cheaper."""
    hidden: tuple[Count, ...] = (128,)
    """Units of the dense layers after the convolutions and the action memory are joined."""
    dueling: Literal["mean", "max"] = "mean"
    """What is subtracted from the advantages: their mean (thesis eq. A.4.6) or maximum (eq. 3.2.8)."""
    input_scale: Positive = 4.0
    """Echo values are multiplied by this before the first filter (measured: mean peak 0.19)."""
    dropout: Annotated[float, Meta(ge=0.0, lt=1.0)] = 0.0
    """Share of hidden units dropped in training."""

    def __post_init__(self) -> None:
        if len(self.channels) != len(self.strides):
            raise ValueError(
                f"channels has {len(self.channels)} entries and strides {len(self.strides)}; give one each"
            )


class Learner(Section, frozen=True):
    """Updates of the network (D3QN: van Hasselt 2016, Wang 2016, Schaul 2016, Horgan 2018)."""

    batch_size: Count = 64
    """Transitions of an update. Thesis 32, Ape-X 512."""
    optimiser: Literal["rmsprop", "adam"] = "rmsprop"
    """Thesis and Ape-X: RMSprop."""
    learning_rate: Positive = 0.00025
    """Step size. Thesis 0.005, Ape-X 0.0000625."""
    rmsprop_decay: Share = 0.95
    """Smoothing of the squared gradients (Ape-X)."""
    rmsprop_centred: bool = False
    """Whether their mean is subtracted (Ape-X: yes)."""
    epsilon: Positive = 1e-5
    """Added to the root of the squared gradients. Ape-X 1.5e-7."""
    weight_decay: NonNegative = 0.0
    """L2 penalty on the weights."""
    loss: Literal["squared", "huber"] = "squared"
    """Per-transition loss of the TD error (thesis: squared)."""
    gradient_clip: NonNegative = 40.0
    """Greatest global norm of the gradient; 0 switches clipping off (Ape-X: 40)."""
    discount: Share = 0.95
    """Gamma, per step. Ape-X 0.99."""
    num_step: Annotated[int, Meta(ge=1, le=16)] = 3
    """n of the n-step return (Ape-X: 3)."""
    target_period: CountOrZero = 500
    """Updates between copies of the target network; 0: the soft update below instead. Ape-X 2,500."""
    target_tau: Share = 0.001
    """Soft update: share of the online network taken over after each update (thesis: 0.001)."""
    weights_period: Count = 25
    """Updates between broadcasts of the weights."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the network; bfloat16 by autocast, with float32 parameters, pays on CUDA and at large batches."""
    compile: bool = False
    """Whether torch compiles the network: a minute at the start (and a C++ compiler on a CPU) for a few percent."""
    prefetch: Annotated[int, Meta(ge=1, le=64)] = 16
    """Batches asked for ahead (Ape-X: up to 16). The learner never waits for one, and each is so much older."""


class Exploration(Section, frozen=True):
    """The epsilon-greedy ladder: actor i of N keeps 0.4^(1 + 7 i / (N - 1)) (Ape-X)."""

    kind: Literal["ladder", "anneal"] = "ladder"
    """`ladder`: one fixed epsilon a bat over all bats of all actors. `anneal`: all bats from start to end (thesis)."""
    base: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.4
    """Base of the ladder (Ape-X)."""
    alpha: NonNegative = 7.0
    """Steepness of the ladder (Ape-X)."""
    single: Share = 0.1
    """Epsilon when there is one bat only, for which the ladder is not defined."""
    anneal_start: Share = 1.0
    """First epsilon of `anneal` (thesis)."""
    anneal_end: Share = 0.01
    """Last epsilon of `anneal` (thesis)."""
    anneal_steps: Count = 20_000
    """Steps of all bats together over which `anneal` runs, linearly."""


class Replay(Section, frozen=True):
    """The central prioritized replay (Schaul 2016, Horgan 2018) and its rate limiter (Reverb's law)."""

    capacity: Annotated[int, Meta(ge=16)] = 200_000
    """Transitions held; the oldest are evicted first. Thesis 50,000, Ape-X 2,000,000."""
    min_size: Count = 2_000
    """Transitions inserted before the first sample. Ape-X 50,000."""
    samples_per_insert: Positive = 8.0
    """How often each transition is sampled, on average. 0.5 to 16 is usual."""
    error_buffer: NonNegative | None = None
    """Half-width of the band around it, in samples; None: a tenth of min_size x samples_per_insert, at least what
    lets both sides make progress."""
    never_block: bool = False
    """Ape-X's mode: neither actors nor learner ever wait for each other; the ratio is whatever the machine gives."""
    alpha: Share = 0.6
    """Exponent of the priorities (Ape-X, thesis)."""
    alpha_end: Share | None = None
    """Exponent that alpha is annealed to over `anneal_updates`; None: constant. The thesis offers 0.9 to 0.01."""
    beta: Share = 0.4
    """Exponent of the importance weights at the first update (Ape-X 0.4 throughout, thesis 0)."""
    beta_end: Share = 1.0
    """Exponent at `anneal_updates` and after (thesis 1)."""
    anneal_updates: Count = 50_000
    """Updates over which alpha and beta run, linearly."""
    priority_epsilon: Positive = 1e-3
    """Added to |TD error|, so that nothing becomes unreachable (thesis: p = |delta| + epsilon)."""
    max_priority: Positive = 10.0
    """Priorities are clipped to this: one mad actor cannot take over the sampling."""
    snapshot_period_s: NonNegative = 60.0
    """Seconds between snapshots of the replay; 0: only at the end."""
    shards: Annotated[int, Meta(ge=1, le=64)] = 1
    """Replay servers that share the transitions."""

    def __post_init__(self) -> None:
        if self.min_size > self.capacity:
            raise ValueError(f"min_size {self.min_size} exceeds capacity {self.capacity}: sampling would never start")


class Actor(Section, frozen=True):
    """How actors gather and send experience."""

    chunk_transitions: Annotated[int, Meta(ge=1, le=1000)] = 50
    """Transitions of one bat sent together (Ape-X: 50)."""
    window_chunks: Annotated[int, Meta(ge=1, le=1024)] = 16
    """Chunks sent and not yet acknowledged before an actor waits; more lets experience grow stale at a busy server."""
    weights_period: Count = 20
    """Steps of a bat between looks for newer weights (Ape-X: 400 frames, 5 to 10 s of flight)."""


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
    """The actors below record every n-th episode of their least exploring bat; 0: none."""
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
    start_timeout_s: Positive = 120.0
    """A new process that has not been heard of for this long is killed and replaced; importing torch takes seconds."""
    heartbeat_timeout_s: Positive = 30.0
    """A role that was heard and then not for this long is killed and replaced; each reports every second."""
    grace_s: Positive = 8.0
    """How long a role may take to end after it was asked to, or after the launcher was killed."""
    stall_s: Positive = 60.0
    """Time without an environment step or an update after which view, status and log say so, and who waits for whom."""
    dense_rows_s: Positive = 3600.0
    """So long each role's metrics get a row a second; then the period grows as elapsed / this, to bound the files."""
    log_max_mb: Positive = 10.0
    """Size at which a log is renamed to NAME.log.1 and begun anew (POSIX; elsewhere logs grow)."""
    log_files: CountOrZero = 3
    """Former logs kept of each role; 0: none, and the log is emptied instead."""


class Config(Section, frozen=True):
    """All settings of a run."""

    seed: CountOrZero = 0
    """Every random stream of a run derives from this one seed."""
    arena: str = "simple"
    """Name of a shipped arena, a file under configs/arenas, or a path to one."""
    condition: Condition = "memory"
    """What the bat may use: three echoes, the newest only, or only the onsets of them (thesis)."""
    actors: Annotated[int, Meta(ge=1, le=4096)] = 2
    """Actor processes."""
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

    def __post_init__(self) -> None:
        absent = [number for number in self.recording.actors if number >= self.actors]
        if absent:
            raise ValueError(
                f"recording.actors names actor {absent[0]}, and the {self.actors} actors have the numbers 0 to"
                f" {self.actors - 1}"
            )

    @property
    def state_steps(self) -> int:
        """Echo frames in a state: `sensing.memory_steps`."""
        return self.sensing.memory_steps

    @property
    def heard_steps(self) -> int:
        """Frames of a state that are not blanked: 1 in the condition no_memory, else all of them."""
        return 1 if self.condition == "no_memory" else self.sensing.memory_steps
