"""The filters of the two renderings against the chain they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from apex_bat.config import settings
from apex_bat.simulation import acoustics, cochlea
from apex_bat.simulation.receiver import receiver


def test_renderings_listen_for_24_ms() -> None:
    thesis, exact = receiver(settings.Sonar()), receiver(settings.Sonar(rendering="exact"))
    assert (thesis.sample_rate_hz, thesis.num_samples) == (125_000, 3000)
    assert (exact.sample_rate_hz, exact.num_samples) == (24_000, 576)


def test_thesis_response_is_the_gammatone_of_the_call() -> None:
    sonar = settings.Sonar()
    sound = np.zeros(700)
    sound[:312] = acoustics.call(sonar, 125_000.0).real
    expected = cochlea.gammatone(sound, 40_000.0, 125_000.0).real
    response = receiver(sonar).response
    np.testing.assert_allclose(response, expected[: len(response)], atol=1e-12)
    assert np.abs(expected[len(response) :]).max() < 1e-10


@pytest.mark.parametrize("sweep_hz", [0.0, 8000.0])
def test_exact_response_is_the_envelope_of_the_thesis_one(sweep_hz: float) -> None:
    fine = receiver(settings.Sonar(summation="random_phase", sweep_hz=sweep_hz)).response
    coarse = receiver(settings.Sonar(rendering="exact", sweep_hz=sweep_hz)).response
    middle_s = (np.arange(len(coarse)) + 0.5) / 24_000 - 16e-6  # the 125 kHz filter answers two samples sooner
    envelope = np.interp(middle_s, np.arange(len(fine)) / 125_000, np.abs(fine), left=0.0, right=0.0)
    np.testing.assert_allclose(np.abs(coarse)[:50], envelope[:50], atol=0.01)
    np.testing.assert_allclose(np.abs(coarse), envelope, atol=0.05)  # and its call ends half a sample later


def test_only_a_sweep_needs_a_complex_baseband() -> None:
    assert not np.iscomplexobj(receiver(settings.Sonar(rendering="exact")).response)
    assert np.iscomplexobj(receiver(settings.Sonar(rendering="exact", sweep_hz=100.0)).response)


def test_tone_fills_its_channel() -> None:
    for rendering in ("thesis", "exact"):
        response = receiver(settings.Sonar(rendering=rendering)).response
        assert np.abs(response).max() == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("rendering", ["thesis", "exact"])
def test_noise_is_as_strong_in_the_channel_as_a_tone_of_its_level(rendering: str) -> None:
    heard = receiver(settings.Sonar(rendering=rendering, receiver_noise_db=50.0))  # type: ignore[arg-type]
    num_parts = 1 if rendering == "thesis" else 2
    noise = heard.noise_pa * np.random.default_rng(7).standard_normal((num_parts, 400_000))
    power = sum(np.square(cochlea.filtered(part, heard.noise_response)).mean() for part in noise)
    if rendering == "exact":
        power /= 2.0  # |y|^2 of a tone of amplitude p is p^2 in the baseband
    assert 10.0 * np.log10(2.0 * power / 4e-10) == pytest.approx(50.0, abs=0.1)


def test_without_noise_its_strength_is_nothing() -> None:
    assert receiver(settings.Sonar()).noise_pa == 0.0
