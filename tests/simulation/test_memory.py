"""The simulation's memory does not grow with the steps that are flown."""

import sys

import numpy as np
import pytest

from apex_bat.config.settings import Rays, Sonar
from apex_bat.simulation.vector import EchoFlightVector

NUM_BATS = 256
WARM_UP_STEPS = 200
STEPS = 2000
"""Times 256 bats: half a million bat steps, a minute; a million were flown once, and passed too."""


def peak_mb() -> float:
    """Returns the most memory that the process has used."""
    resource = pytest.importorskip("resource")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak / (1e6 if sys.platform == "darwin" else 1e3))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_memory_stays_flat_over_half_a_million_bat_steps() -> None:
    few, cheap = Rays(num_azimuth=10, num_elevation=2, num_clearance=90), Sonar(rendering="exact")
    env = EchoFlightVector(NUM_BATS, rays=few, sonar=cheap)
    env.reset(seed=0)
    generator = np.random.default_rng(0)
    episodes = 0
    before_mb = 0.0
    for step in range(STEPS):
        if step == WARM_UP_STEPS:
            before_mb = peak_mb()
        _, _, terminated, truncated, _ = env.step(generator.integers(0, 3, NUM_BATS))
        episodes += int((terminated | truncated).sum())
    env.close()
    assert episodes > 10_000
    assert peak_mb() - before_mb < 2.0
