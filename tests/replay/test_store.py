"""The store: what each setting of the replay does, and what is counted."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from apex_bat.config.settings import Config
from apex_bat.experience import Chunk
from apex_bat.replay.metrics import PRIORITY_BINS, SHARED_ACTORS
from apex_bat.replay.store import RefusedChunkError, ReplayStore, limiter_of

MakeChunk = Callable[..., Chunk]


def with_replay(config: Config, **changes: object) -> Config:
    return msgspec.structs.replace(config, replay=msgspec.structs.replace(config.replay, **changes))


def filled(config: Config, make_chunk: MakeChunk, priorities: tuple[float, ...]) -> ReplayStore:
    """Returns a store with ten transitions of each priority; actors are named by their order."""
    store = ReplayStore(config, np.random.default_rng(0))
    for index, priority in enumerate(priorities):
        store.add(f"actor{index}", index, [make_chunk(10, priority=priority)])
    return store


def shares(store: ReplayStore, learner_step: int = 0, groups: int = 2) -> list[float]:
    items = np.concatenate([store.sample(1000, learner_step).items for _ in range(10)])
    return [float(share) for share in np.bincount(items // 10, minlength=groups) / len(items)]


def test_sampling_follows_clipped_priorities_with_epsilon_and_exponent(config: Config, make_chunk: MakeChunk) -> None:
    settings = with_replay(config, alpha=0.5, max_priority=4.0, priority_epsilon=1.0)
    store = filled(settings, make_chunk, (0.0, 1e30))
    # A mad priority counts as 4 + 1, nothing as 0 + 1: sqrt(5) to 1.
    assert shares(store)[1] == pytest.approx(5**0.5 / (1 + 5**0.5), abs=0.01)


def test_negative_errors_count_by_their_size(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(with_replay(config, alpha=1.0), make_chunk, (1.0, -3.0))
    assert shares(store)[1] == pytest.approx(0.75, abs=0.01)


def test_alpha_and_beta_are_annealed_by_the_learner_step(config: Config, make_chunk: MakeChunk) -> None:
    settings = with_replay(config, alpha=1.0, alpha_end=0.0, beta=0.0, beta_end=1.0, anneal_updates=100)
    store = filled(settings, make_chunk, (1.0, 3.0))
    assert shares(store, 0)[1] == pytest.approx(0.75, abs=0.01)
    assert (store.sample(100, 0).weights == 1.0).all()
    assert shares(store, 50)[1] == pytest.approx(3**0.5 / (1 + 3**0.5), abs=0.01)
    middle = store.sample(100, 50).weights
    assert middle.min() == pytest.approx((3**0.5) ** -0.5, rel=1e-3)  # beta 0.5 on shares 1 : sqrt(3)
    assert shares(store, 500)[1] == pytest.approx(0.5, abs=0.01)
    assert store.metrics()["replay.beta"] == 1.0


def test_updates_change_the_sampling_and_bad_ones_are_counted(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(with_replay(config, alpha=1.0), make_chunk, (1.0, 1.0))
    store.update(3, np.arange(10), np.full(10, 9.0, np.float32))
    assert shares(store)[0] == pytest.approx(0.9, abs=0.01)
    store.update(3, np.array([0, 1, 77]), np.array([np.nan, 9.0, 9.0], np.float32))
    assert shares(store)[0] == pytest.approx(0.9, abs=0.01)
    assert store.metrics()["replay.late_priorities"] == 1
    assert store.metrics()["replay.updated_priorities"] == 11
    assert store.metrics()["replay.refused_priorities"] == 1


def test_lag_age_and_shares_are_measured(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(with_replay(config, alpha=1.0, priority_epsilon=1e-9), make_chunk, (1.0, 0.0))
    store.sample(100, learner_step=30)  # only the first actor's ten, made at learner step 0
    figures = store.metrics()
    assert figures["replay.sampled_lag"] == 30.0
    assert figures["replay.policy_lag"] == 0.0
    assert figures["replay.item_age"] == pytest.approx(15.5, abs=0.1)  # items 0 to 9 of 20
    assert store.actor_shares() == {"actor0": (0.5, 1.0), "actor1": (0.5, 0.0)}
    assert figures["replay.greatest_inserted_share"] == 0.5


def test_everything_added_is_held_or_evicted(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(with_replay(config, capacity=95, min_size=10), make_chunk, (1.0,) * 30)
    figures = store.metrics()
    assert figures["replay.inserted"] == 300 == figures["replay.size"] + figures["replay.evicted"]
    assert figures["replay.size"] == 95


def test_the_first_sample_waits_for_min_size(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(config, make_chunk, (1.0,))
    assert not store.can_sample(16)
    store.add("a", 0, [make_chunk(10)])
    assert store.can_sample(16)


def test_shards_share_the_capacity_and_the_minimum(config: Config) -> None:
    store = ReplayStore(with_replay(config, shards=3), np.random.default_rng(0))
    assert store.buffer.capacity == 334
    assert store.limiter.min_size == 7


def test_limiter_settings_reach_the_limiter(config: Config) -> None:
    store = ReplayStore(
        with_replay(config, samples_per_insert=2.0, error_buffer=500.0, never_block=True), np.random.default_rng(0)
    )
    assert (store.limiter.samples_per_insert, store.limiter.error_buffer) == (2.0, 500.0)
    assert store.limiter.never_block


def test_full_chunks_never_run_out_of_rows(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(config, make_chunk, (1.0,) * 150)
    assert len(store.buffer) == store.buffer.capacity


def test_an_insert_with_a_bad_chunk_is_refused_whole_and_names_its_actor(config: Config, make_chunk: MakeChunk) -> None:
    store = ReplayStore(config, np.random.default_rng(0))
    bad = make_chunk(10)._replace(starts=np.arange(1, 11, dtype=np.uint16))
    with pytest.raises(RefusedChunkError, match="actor 7"):
        store.add("actor 7", 0, [make_chunk(10), bad])
    assert len(store.buffer) == 0


def test_policy_lag_is_that_of_the_weights_that_flew_what_arrives(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(config, make_chunk, (1.0,))
    store.learner_step = 40
    store.add("late", 15, [make_chunk(10)])
    assert store.metrics()["replay.policy_lag"] == 25.0


def test_without_action_memory_the_learner_sees_no_actions(config: Config, make_chunk: MakeChunk) -> None:
    deaf = msgspec.structs.replace(config, sensing=msgspec.structs.replace(config.sensing, action_memory=False))
    for settings, expected in ((config, True), (deaf, False)):
        batch = filled(settings, make_chunk, (1.0, 1.0)).sample(100, 0)
        assert bool(batch.states.actions.any()) == expected
        assert bool(batch.next_states.actions.any()) == expected


def test_the_histogram_of_the_priorities_shows_where_they_lie(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(config, make_chunk, (0.0, 1.0, 1.0, 1e9))
    histogram = {name: share for name, share in store.metrics().items() if name.startswith("replay.priority_hist.")}
    assert list(histogram.values()) == [
        pytest.approx({0: 0.25, 12: 0.5, 15: 0.25}.get(k, 0.0)) for k in range(PRIORITY_BINS)
    ]


def test_the_shares_of_an_actor_whose_priorities_stand_out_differ(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(with_replay(config, alpha=1.0), make_chunk, (1.0, 3.0))
    for _ in range(10):
        store.sample(1000, 0)
    metrics = store.metrics()
    assert metrics["replay.inserted_share.actor1"] == 0.5
    assert metrics["replay.sampled_share.actor1"] == pytest.approx(0.75, abs=0.01)


def test_only_the_actors_sampled_most_are_named(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(with_replay(config, capacity=1000), make_chunk, (0.0,) * SHARED_ACTORS + (9.0,))
    store.sample(1000, 0)
    named = [name for name in store.metrics() if name.startswith("replay.sampled_share.")]
    assert len(named) == SHARED_ACTORS
    assert named[0] == f"replay.sampled_share.actor{SHARED_ACTORS}"


def test_a_law_that_was_changed_holds_on_after_a_restore(config: Config, make_chunk: MakeChunk) -> None:
    store = filled(config, make_chunk, (1.0, 1.0, 1.0))
    store.limiter.change(2.0)
    store.limiter.count_sample(5)
    other = ReplayStore(config, np.random.default_rng(1))
    other.restore(store.state())
    assert other.limiter.law == store.limiter.law
    assert other.limiter.balance == store.limiter.balance


def test_the_least_band_that_an_error_names_is_that_of_all_servers(config: Config) -> None:
    with pytest.raises(ValueError, match="buffer 3 is too narrow, shared out over 3 servers") as error:
        limiter_of(with_replay(config, shards=3, error_buffer=3.0))
    least = float(str(error.value).rpartition(" ")[2])
    assert limiter_of(with_replay(config, shards=3, error_buffer=least)).error_buffer == pytest.approx(least / 3)
    with pytest.raises(ValueError, match="too narrow"):
        limiter_of(with_replay(config, shards=3, error_buffer=least - 1))
