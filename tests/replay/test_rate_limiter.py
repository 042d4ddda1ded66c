"""The law of the rate limiter, as a table and under random demands."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_bat.replay.rate_limiter import RateLimiter


def limiter(error_buffer: float | None = 20.0, *, never_block: bool = False) -> RateLimiter:
    return RateLimiter(2.0, 10, error_buffer, largest_insert=5, largest_sample=8, never_block=never_block)


@pytest.mark.parametrize(
    ("inserted", "sampled", "may_insert", "may_sample"),
    [
        (0, 0, True, False),  # below min_size: inserts only
        (9, 0, True, False),
        (10, 0, True, True),  # balance 0
        (15, 0, True, True),  # balance 10: five more reach 20 exactly
        (16, 0, False, True),  # balance 12: five more would be 22
        (10, 12, True, True),  # balance -12: eight more reach -20 exactly
        (10, 13, True, False),
        (100, 180, True, True),
    ],
)
def test_who_may_go_on(inserted: int, sampled: int, may_insert: bool, may_sample: bool) -> None:
    one = limiter()
    one.count_insert(inserted)
    one.count_sample(sampled)
    assert one.can_insert(5) is may_insert
    assert one.can_sample(8) is may_sample


@given(
    ratio=st.floats(0.1, 32),
    min_size=st.integers(1, 500),
    insert=st.integers(1, 300),
    sample=st.integers(1, 600),
    extra=st.floats(0, 1000),
    seed=st.integers(0, 1000),
)
def test_the_ratio_stays_in_its_band_and_nobody_waits_for_ever(
    ratio: float, min_size: int, insert: int, sample: int, extra: float, seed: int
) -> None:
    error_buffer = (ratio * insert + sample) / 2 + extra
    one = RateLimiter(ratio, min_size, error_buffer, largest_insert=insert, largest_sample=sample)
    generator = np.random.default_rng(seed)
    for _ in range(300):
        wants_insert = generator.random() < 0.5
        if wants_insert and one.can_insert(insert):
            one.count_insert(insert)
        elif not wants_insert and one.can_sample(sample):
            one.count_sample(sample)
        assert one.can_insert(insert) or one.can_sample(sample)
        overshoot = ratio * insert  # of the insert that reached min_size
        assert -error_buffer <= one.balance + ratio * min_size * (one.inserted < min_size)
        assert one.balance <= error_buffer + overshoot


def test_a_band_in_which_both_sides_could_wait_is_refused_with_the_least_that_works() -> None:
    with pytest.raises(ValueError, match="give at least 9"):
        limiter(8.9)
    assert limiter(9.0).error_buffer == 9.0


def test_the_default_band_is_a_tenth_or_the_least_that_works() -> None:
    assert limiter(None).error_buffer == 9.0
    assert RateLimiter(2.0, 1000, None, largest_insert=5, largest_sample=8).error_buffer == 200.0


def test_never_block_waits_only_for_the_first_transitions() -> None:
    one = limiter(0.0, never_block=True)
    assert not one.can_sample(8)
    one.count_insert(10_000)
    assert one.can_insert(5)
    one.count_sample(1_000_000)
    assert one.can_sample(8)


def test_a_change_while_running_holds_from_then_on() -> None:
    one = limiter()
    one.count_insert(100)
    one.count_sample(180)
    one.change(8.0, 40.0)
    assert one.balance == 0.0
    one.count_insert(5)
    assert one.balance == 40.0
    assert not one.can_insert(1)
    with pytest.raises(ValueError, match="too narrow"):
        one.change(100.0, 40.0)
    assert one.samples_per_insert == 8.0


def test_a_change_before_the_first_sample_keeps_min_size() -> None:
    one = limiter()
    one.count_insert(5)
    one.change(8.0, 100.0)
    one.count_insert(7)
    assert one.balance == 16.0


def test_it_says_who_waits_for_whom() -> None:
    one = limiter()
    assert "10 transitions are missing" in one.waiting_reason()
    one.count_insert(10)
    assert one.waiting_reason() == ""
    one.count_insert(10)
    assert "actors wait for the learner" in one.waiting_reason()
    one.count_sample(40)
    assert "learner waits for actors" in one.waiting_reason()


def test_restored_counters_go_on_where_they_stopped() -> None:
    one, other = limiter(), limiter()
    one.count_insert(50)
    one.change(3.0, 60.0)
    one.count_insert(4)
    other.restore(one.counters())
    other.samples_per_insert = 3.0
    assert other.balance == one.balance == 12.0


def test_the_measured_ratio_counts_from_the_first_sample() -> None:
    one = limiter()
    assert one.measured_ratio == 0.0
    one.count_insert(30)
    one.count_sample(40)
    assert one.measured_ratio == 2.0


def test_a_changed_ratio_keeps_the_band_of_the_settings_where_it_is_wide_enough() -> None:
    limiter = RateLimiter(8.0, 100, 5_000.0, largest_insert=50, largest_sample=64)
    limiter.change(4.0)
    assert limiter.law == (4.0, 5_000.0)
    limiter.change(1_000.0)
    assert limiter.law == (1_000.0, (1_000.0 * 50 + 64) / 2)
    limiter.change(4.0, 300.0)
    assert limiter.law == (4.0, 300.0)
