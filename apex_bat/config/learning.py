"""Settings of what learns: network, updates, exploration, replay, and how actors feed it."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from apex_bat.config.sections import Count, CountOrZero, NonNegative, Positive, Section, Share


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
    learning_rate: Positive = 0.0005
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
    target_period: CountOrZero = 100
    """Updates between copies of the target network; 0: the soft update below instead. Ape-X 2,500."""
    target_tau: Share = 0.001
    """Soft update: share of the online network taken over after each update (thesis: 0.001)."""
    averaged_updates: CountOrZero = 1_500
    """Updates over which the parameters are averaged, exponentially, into the policy that is judged, recorded and kept
    as the best; at first over a tenth of the updates so far. 0: no average. Actors fly with the online network."""
    mirror: bool = True
    """Whether half of each batch is mirrored: left for right in ears and turns."""
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
    """Replay servers that share the transitions, each with its part of capacity, min_size and error_buffer. More than
    one pays when one server's core or memory is full: docs/scaling.md."""

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
