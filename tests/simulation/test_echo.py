"""The stages of an echo: each follows from the one before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from apex_bat.simulation import cochlea
from apex_bat.simulation.echo import Echo
from apex_bat.simulation.sonar import Sonar

GENERATOR = np.random.default_rng(13)
AZIMUTH, ELEVATION = GENERATOR.uniform(-1.5, 1.5, (2, 60)), GENERATOR.uniform(0.0, 0.5, (2, 60))
RANGE_M = GENERATOR.uniform(0.5, 4.0, (2, 60))


def echo(**changes: Any) -> Echo:
    return Sonar(**changes).hear(AZIMUTH, ELEVATION, RANGE_M)


def test_stages_of_the_thesis_have_their_shapes() -> None:
    heard = echo()
    assert heard.level_db.shape == (2, 2, 60)
    stages = ("impulse_response", "pressure_pa", "gammatone", "rectified", "compressed", "envelope")
    assert {stage: getattr(heard, stage).shape for stage in stages} == dict.fromkeys(stages, (2, 2, 3000))
    assert heard.frame.shape == (2, 2, 24)
    assert heard.frame.dtype == np.float32
    assert heard.cochleagram.shape == (2, 2, len(heard.cochleagram_hz), 120)


def test_stages_of_the_exact_rendering_have_their_shapes() -> None:
    heard = echo(rendering="exact")
    assert heard.pressure_pa is None
    stages = ("impulse_response", "gammatone", "rectified", "compressed", "envelope")
    assert {stage: getattr(heard, stage).shape for stage in stages} == dict.fromkeys(stages, (2, 2, 576))
    assert heard.frame.shape == (2, 2, 24)
    assert heard.cochleagram.shape == (2, 2, len(heard.cochleagram_hz), 120)


def test_bats_together_are_the_bats_one_by_one() -> None:
    for rendering in ("thesis", "exact"):
        alone = Sonar(rendering=rendering).hear(AZIMUTH[1], ELEVATION[1], RANGE_M[1])
        assert alone.frame.shape == (2, 24)
        np.testing.assert_array_equal(alone.frame, echo(rendering=rendering).frame[1])


def test_each_stage_follows_from_the_one_before() -> None:
    heard = echo()
    np.testing.assert_array_equal(heard.rectified, np.maximum(heard.gammatone.real, 0.0))
    np.testing.assert_allclose(heard.compressed, heard.rectified**0.4)
    np.testing.assert_array_equal(heard.envelope, cochlea.low_pass(heard.compressed, 125_000.0))
    np.testing.assert_allclose(heard.frame[..., 7], heard.envelope[..., 875:1000].mean(axis=-1), rtol=1e-6)


def test_a_range_is_heard_from_its_sample() -> None:
    for range_m in (0.3, 1.0, 2.2, 4.0):
        first = round(2.0 * range_m / 343.0 * 125_000.0)
        heard = Sonar(directivity="omni").hear([0.0], [0.0], [range_m])
        assert heard.pressure_pa is not None
        np.testing.assert_array_equal(np.flatnonzero(heard.impulse_response[0]), [first])
        assert np.flatnonzero(heard.pressure_pa[0])[0] == first + 1  # the call starts with a sample of 0
        assert not heard.envelope[0, : first + 1].any()


def test_exact_rendering_shares_an_echo_between_the_samples_around_its_delay() -> None:
    taps = Sonar(rendering="exact", directivity="omni").hear([0.0], [0.0], [1.0]).impulse_response[0]
    delay = 2.0 / 343.0 * 24_000.0
    assert np.abs(taps) @ np.arange(576) / np.abs(taps).sum() == pytest.approx(delay, abs=1e-4)


def test_an_echo_of_a_call_is_as_loud_as_its_level() -> None:
    heard = Sonar(directivity="omni").hear([0.0], [0.0], [1.0])
    assert heard.pressure_pa is not None
    assert np.abs(heard.pressure_pa).max() == pytest.approx(2e-5 * 10.0 ** (57.364 / 20.0), rel=3e-3)


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
@pytest.mark.parametrize("summation", ["coherent", "incoherent"])
def test_cochleagram_holds_the_frame_in_the_channel_of_the_call(rendering: str, summation: str) -> None:
    heard = echo(rendering=rendering, summation=summation)
    channel = int(np.argmin(np.abs(heard.cochleagram_hz - 40_000.0)))
    means = heard.cochleagram[:, :, channel].reshape(2, 2, 24, 5).mean(axis=-1)
    assert np.linalg.norm(means - heard.frame) < 0.1 * np.linalg.norm(heard.frame)
    assert heard.cochleagram.mean(axis=(0, 1, 3)).argmax() == pytest.approx(channel, abs=1)


def test_sweep_passes_through_the_channels_one_after_another() -> None:
    heard = Sonar(directivity="omni", sweep_hz=-30_000.0, call_duration_s=0.005).hear([0.0], [0.0], [1.0])
    high, low = (int(np.argmin(np.abs(heard.cochleagram_hz - hz))) for hz in (50_000.0, 30_000.0))
    assert heard.cochleagram[0, high].argmax() + 10 < heard.cochleagram[0, low].argmax()
