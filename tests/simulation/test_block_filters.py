"""The block filters against the sample-by-sample ones of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from apex_bat.simulation.block_filters import BlockFilter, BlockLowPass


def sounds(num_parts: int) -> NDArray[np.float64]:
    return np.random.default_rng(8).normal(size=(2, num_parts, 120))


def apply(block_filter: BlockFilter, sound: NDArray[np.float64], first_sample: int = 0) -> NDArray[np.float32]:
    block_filter.sound[:] = sound
    return block_filter(first_sample)


@pytest.mark.parametrize("num_taps", [1, 7, 24, 50])
@pytest.mark.parametrize("num_parts", [1, 2])
def test_real_filter_filters_each_part_alike(num_taps: int, num_parts: int) -> None:
    response, sound = np.random.default_rng(9).normal(size=num_taps), sounds(num_parts)
    filtered = apply(BlockFilter(response[None, None], num_parts, 120, block=24), sound)
    np.testing.assert_allclose(filtered, signal.lfilter(response, [1.0], sound), atol=1e-5)


def test_mixing_filter_is_complex_multiplication() -> None:
    real, imaginary = np.random.default_rng(10).normal(size=(2, 30))
    sound = sounds(2)
    filtered = apply(BlockFilter(np.array(((real, imaginary), (-imaginary, real))), 2, 120, block=20), sound)
    expected = signal.lfilter(real + 1j * imaginary, [1.0], sound[:, 0] + 1j * sound[:, 1])
    np.testing.assert_allclose(filtered[:, 0] + 1j * filtered[:, 1], expected, atol=1e-5)


def test_filter_remembers_nothing_of_the_call_before() -> None:
    block_filter = BlockFilter(np.ones((1, 1, 40)), 1, 120, block=24)
    first = apply(block_filter, sounds(1))
    apply(block_filter, np.full((2, 1, 120), 1e6))
    np.testing.assert_array_equal(apply(block_filter, sounds(1)), first)


def test_silence_before_an_echo_is_exactly_silent() -> None:
    sound = np.zeros((2, 1, 120))
    sound[:, 0, 50] = 1.0
    filtered = apply(BlockFilter(np.ones((1, 1, 40)), 1, 120, block=24), sound)
    assert not filtered[..., :50].any()
    assert filtered[..., 50].all()


@pytest.mark.parametrize("first_sample", [0, 1, 31, 32, 77, 119, 120])
def test_blocks_before_the_first_sound_may_be_left_out(first_sample: int) -> None:
    sound, block_filter = sounds(1), BlockFilter(np.ones((1, 1, 40)), 1, 120, block=8)
    apply(block_filter, sound)
    sound[..., :first_sample] = 0.0
    np.testing.assert_array_equal(apply(block_filter, sound, first_sample), apply(block_filter, sound))


@pytest.mark.parametrize(
    ("rate_hz", "num_samples", "block"), [(125_000, 3000, 60), (125_000, 3000, 25), (24_000, 576, 48)]
)
def test_block_low_pass_is_the_butterworth_filter(rate_hz: int, num_samples: int, block: int) -> None:
    compressed = np.random.default_rng(11).random((2, num_samples)).astype(np.float32)
    expected = signal.lfilter(*signal.butter(2, 1000.0, fs=rate_hz), compressed.astype(np.float64))
    envelope = BlockLowPass(rate_hz, num_samples, block)(compressed)
    np.testing.assert_allclose(envelope, expected, atol=1e-6)
