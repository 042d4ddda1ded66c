"""The replay without a wire: buffer, rate limiter, annealing and counters, as a server or the serial mode uses them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Config
from apex_bat.experience import ACTION_MEMORY, Batch, Chunk
from apex_bat.replay.buffer import ReplayBuffer, Sampled
from apex_bat.replay.metrics import PRIORITY_EDGES, SHARED_ACTORS
from apex_bat.replay.rate_limiter import LimiterCounters, RateLimiter

MAX_ACTORS = 65_535
ALPHA_STEPS = 100  # alpha is annealed in so many steps: each rebuilds the tree
ROW_RESERVE = 1.1  # rows beyond those of full chunks, for the shorter ones at the ends of episodes
HISTOGRAM_ITEMS = 4096  # looked at for the histogram of the priorities: 0.2 ms, and exact to some tenths of a percent
SMOOTHING = 0.01  # of the running means over sampled batches


class RefusedChunkError(ValueError):
    """A chunk that cannot be stored here; the message says why."""


class _Means(NamedTuple):
    """Running means, over arriving inserts and over sampled items."""

    policy_lag: float = 0.0
    sampled_lag: float = 0.0
    item_age: float = 0.0


class ReplayStore:
    """Prioritized replay with a rate limiter.

    Args:
        config: the settings; those of `replay` are shared out over `replay.shards`.
        generator: draws the samples.

    Attributes:
        buffer: the memory.
        limiter: the law of samples per insert.
        learner_step: updates of the learner, as its last message told.
        first_number: what the items' numbers begin with outside. A store that goes on from an older snapshot gives
            numbers again that were given since, so a server has others in each life: priorities that the learner sends
            for items of an earlier life are late, and land on no other item.
    """

    def __init__(self, config: Config, generator: np.random.Generator) -> None:
        settings = config.replay
        self._settings = settings
        self._generator = generator
        capacity = math.ceil(settings.capacity / settings.shards)
        chunk = config.actor.chunk_transitions
        context = max(config.state_steps - 1, ACTION_MEMORY)
        rows_each = ROW_RESERVE * (chunk + context + config.learner.num_step) / chunk
        num_rows = math.ceil((capacity + config.largest_insert) * rows_each)
        self.buffer = ReplayBuffer(capacity, num_rows, config.state_steps, config.heard_steps, settings.alpha)
        self.limiter = limiter_of(config)
        self._has_action_memory = config.sensing.action_memory
        self.learner_step = 0
        self.first_number = 0
        self._updated_priorities = 0
        self._late_priorities = 0
        self._refused_priorities = 0
        self._actors: dict[str, int] = {}
        self._inserted_by = np.zeros(0, np.int64)
        self._sampled_by = np.zeros(0, np.int64)
        self._means = _Means()

    def add(self, actor: str, learner_step: int, chunks: Sequence[Chunk]) -> None:
        """Adds all chunks of an insert, or none.

        Args:
            actor: who made them.
            learner_step: updates that its weights had seen.
            chunks: their raw priorities are clipped and get the epsilon here.

        Raises:
            RefusedChunkError: a chunk does not fit.
        """
        try:
            self.buffer.check(chunks)
        except ValueError as error:
            raise RefusedChunkError(f"{actor}: {error}") from error
        index = self._index_of(actor)
        priorities = self._trusted(np.concatenate([chunk.priorities for chunk in chunks]))
        self.buffer.add(chunks, priorities, index, learner_step)
        self.limiter.count_insert(len(priorities))
        self._inserted_by[index] += len(priorities)
        lag = float(max(self.learner_step - learner_step, 0))
        self._means = self._means._replace(policy_lag=_smoothed(self._means.policy_lag, lag))

    @property
    def beta(self) -> float:
        """Exponent of the importance weights now."""
        return self._settings.beta + (self._settings.beta_end - self._settings.beta) * self._progress()

    def can_add(self, num_transitions: int) -> bool:
        """Whether the limiter lets so many transitions in now."""
        return self.limiter.can_insert(num_transitions)

    def can_sample(self, num_transitions: int) -> bool:
        """Whether the limiter lets so many transitions out now."""
        return len(self.buffer) > 0 and self.limiter.can_sample(num_transitions)

    def sample(self, num_transitions: int, learner_step: int) -> Batch:
        """Returns a batch; the caller has asked `can_sample`, and calls `count_sample` when it is delivered."""
        return self.draw(num_transitions, learner_step).batch

    def draw(self, num_transitions: int, learner_step: int) -> Sampled:
        """Returns a batch and what is known about it beside, as `sample` does."""
        self.learner_step = learner_step
        self.anneal()
        sampled = self.buffer.sample(num_transitions, self.beta, self._generator)
        lag = float(np.maximum(learner_step - sampled.learner_steps, 0).mean())
        age = float((self.buffer.counters.next_item - sampled.batch.items).mean())
        self._means = self._means._replace(
            sampled_lag=_smoothed(self._means.sampled_lag, lag), item_age=_smoothed(self._means.item_age, age)
        )
        self._sampled_by += np.bincount(sampled.actors, minlength=len(self._sampled_by))
        if not self._has_action_memory:
            sampled.batch.states.actions[:] = 0
            sampled.batch.next_states.actions[:] = 0
        return sampled._replace(batch=sampled.batch._replace(items=sampled.batch.items + self.first_number))

    def anneal(self) -> None:
        """Sets the exponent of the priorities to that of the learner's step; `draw` does it too."""
        self.buffer.set_alpha(self._alpha())

    def count_sample(self, num_transitions: int) -> None:
        """Counts a batch that was delivered."""
        self.limiter.count_sample(num_transitions)

    def update(self, learner_step: int, items: NDArray[np.int64], errors: NDArray[np.float32]) -> None:
        """Sets the priorities of items by their new |TD errors|; late and non-finite ones are counted and dropped."""
        self.learner_step = learner_step
        finite = np.isfinite(errors)
        if not finite.all():
            self._refused_priorities += int(np.count_nonzero(~finite))
            items, errors = items[finite], errors[finite]
        late = self.buffer.update(items - self.first_number, self._trusted(errors))
        self._late_priorities += late
        self._updated_priorities += len(items) - late

    def actor_shares(self) -> dict[str, tuple[float, float]]:
        """Returns for each actor its share of all inserted and of all sampled transitions."""
        inserted = self._inserted_by / max(1, self._inserted_by.sum())
        sampled = self._sampled_by / max(1, self._sampled_by.sum())
        return {actor: (float(inserted[i]), float(sampled[i])) for actor, i in self._actors.items()}

    def metrics(self) -> dict[str, float]:
        """Returns the figures that `replay.metrics.METRICS` describes, without those of the wire."""
        shares = self.actor_shares()
        most_sampled = sorted(shares, key=lambda actor: shares[actor][1], reverse=True)[:SHARED_ACTORS]
        counters = self.buffer.counters
        return {
            "replay.size": len(self.buffer),
            "replay.inserted": self.limiter.inserted,
            "replay.sampled": self.limiter.sampled,
            "replay.drawn": int(self._sampled_by.sum()),
            "replay.evicted": counters.first_item,
            "replay.updated_priorities": self._updated_priorities,
            "replay.late_priorities": self._late_priorities,
            "replay.refused_priorities": self._refused_priorities,
            "replay.samples_per_insert": self.limiter.measured_ratio,
            "replay.wanted_samples_per_insert": self.limiter.samples_per_insert,
            "replay.balance": self.limiter.balance,
            "replay.policy_lag": self._means.policy_lag,
            "replay.sampled_lag": self._means.sampled_lag,
            "replay.item_age": self._means.item_age,
            "replay.actors": len(self._actors),
            "replay.greatest_inserted_share": max((share for share, _ in shares.values()), default=0.0),
            "replay.greatest_sampled_share": max((share for _, share in shares.values()), default=0.0),
            **{f"replay.inserted_share.{actor}": shares[actor][0] for actor in most_sampled},
            **{f"replay.sampled_share.{actor}": shares[actor][1] for actor in most_sampled},
            "replay.alpha": self.buffer.alpha,
            "replay.beta": self.beta,
            "replay.mb": self.buffer.nbytes / 1e6,
            **self._priority_histogram(),
        }

    def state(self) -> dict[str, Any]:
        """Returns all but the arrays of the buffer, as plain values, for a snapshot."""
        return {
            "buffer": list(self.buffer.counters),
            "alpha": self.buffer.alpha,
            "limiter": list(self.limiter.counters()),
            "law": list(self.limiter.law),
            "learner_step": self.learner_step,
            "updated_priorities": self._updated_priorities,
            "late_priorities": self._late_priorities,
            "refused_priorities": self._refused_priorities,
            "actors": list(self._actors),
            "inserted_by": self._inserted_by.tolist(),
            "sampled_by": self._sampled_by.tolist(),
            "means": list(self._means),
            "generator": self._generator.bit_generator.state,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Takes over what `state` returned; the buffer's arrays and counters are restored by `snapshot`."""
        self.limiter.change(*state["law"])
        self.limiter.restore(LimiterCounters(*state["limiter"]))
        self.learner_step = state["learner_step"]
        self._updated_priorities = state["updated_priorities"]
        self._late_priorities = state["late_priorities"]
        self._refused_priorities = state["refused_priorities"]
        self._actors = {actor: i for i, actor in enumerate(state["actors"])}
        self._inserted_by = np.array(state["inserted_by"], np.int64)
        self._sampled_by = np.array(state["sampled_by"], np.int64)
        self._means = _Means(*state["means"])
        self._generator.bit_generator.state = state["generator"]

    def _priority_histogram(self) -> dict[str, float]:
        priorities = self.buffer.some_priorities(HISTOGRAM_ITEMS)
        within = np.clip(priorities, PRIORITY_EDGES[0], np.nextafter(PRIORITY_EDGES[-1], 0.0))
        counts, _ = np.histogram(within, PRIORITY_EDGES)
        shares = counts / max(1, len(priorities))
        return {f"replay.priority_hist.{k:02d}": float(share) for k, share in enumerate(shares)}

    def _trusted(self, errors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns priorities from |TD errors|: clipped, so that nobody can take over the sampling, plus epsilon."""
        clipped = np.minimum(np.abs(errors), np.float32(self._settings.max_priority))
        priorities: NDArray[np.float32] = clipped + np.float32(self._settings.priority_epsilon)
        return priorities

    def _index_of(self, actor: str) -> int:
        if actor not in self._actors:
            if len(self._actors) == MAX_ACTORS:
                raise RefusedChunkError(f"{actor}: there are {MAX_ACTORS} other actors already")
            self._actors[actor] = len(self._actors)
            self._inserted_by = np.append(self._inserted_by, 0)
            self._sampled_by = np.append(self._sampled_by, 0)
        return self._actors[actor]

    def _progress(self) -> float:
        return min(1.0, self.learner_step / self._settings.anneal_updates)

    def _alpha(self) -> float:
        start, end = self._settings.alpha, self._settings.alpha_end
        if end is None:
            return start
        return start + (end - start) * math.floor(self._progress() * ALPHA_STEPS) / ALPHA_STEPS


def _smoothed(mean: float, value: float) -> float:
    return value if mean == 0.0 else mean + SMOOTHING * (value - mean)


def limiter_of(config: Config) -> RateLimiter:
    """Returns the rate limiter of one store of `replay.shards`: each has its part of the first size and of the band.

    Raises:
        ValueError: actors and learner could come to wait for each other.
    """
    settings = config.replay
    return RateLimiter(
        settings.samples_per_insert,
        math.ceil(settings.min_size / settings.shards),
        None if settings.error_buffer is None else settings.error_buffer / settings.shards,
        largest_insert=config.largest_insert,
        largest_sample=config.learner.batch_size,
        never_block=settings.never_block,
        shards=settings.shards,
    )
