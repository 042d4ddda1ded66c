"""The evaluator judges checkpoints, tells the norms of their weights, and records the flights that it is asked to."""

from __future__ import annotations

import threading
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.config import load
from apex_bat.recording.catalog import list_flights
from apex_bat.roles import checkpoint
from apex_bat.roles.checkpoint import Checkpoint
from apex_bat.roles.evaluator import OTHER_STARTS, Evaluator
from apex_bat.roles.plan import Addresses, Assignment, Role
from apex_bat.simulation.vector import EchoFlightVector

SMALL = ("network.channels=[4]", "network.strides=[3]", "network.hidden=[8]", "sonar.rendering=exact",
         "evaluation.flights=2", "episode.evaluation_steps=15")  # fmt: skip


@pytest.mark.parametrize("sampled", [0, 1])
def test_as_many_flights_of_a_checkpoint_are_recorded_as_the_settings_say(sampled: int, tmp_path: Path) -> None:
    config = load(None, [*SMALL, f"recording.sampled_flights={sampled}", "evaluation.period_s=0.001"])
    agent = D3QN(config, torch.device("cpu"))
    state = Checkpoint(7, checkpoint.fingerprint(config), {}, agent.arrays())
    (tmp_path / "checkpoints").mkdir()
    checkpoint.save(tmp_path / "checkpoints", state, keep=2)
    addresses = Addresses(*(f"ipc://{tmp_path}/{name}" for name in ("replay", "weights", "reports")))
    assignment = Assignment(Role("evaluator", 0), config, tmp_path, addresses, threading.Event(), 0)
    with closing(Evaluator(assignment)) as evaluator:
        while not (tmp_path / "checkpoints" / checkpoint.BEST).exists():
            evaluator.step()
    if sampled:
        (entry,) = list_flights(tmp_path)
        assert (entry.kind, entry.checkpoint_step, entry.seed) == (
            "evaluation",
            7,
            config.evaluation.start_seed + OTHER_STARTS,
        )
    else:
        assert not (tmp_path / "recordings").exists()


def test_no_start_of_the_choice_of_the_best_is_one_of_the_final_evaluation() -> None:
    config = load(None)
    seeds = (config.evaluation.start_seed, config.evaluation.start_seed + OTHER_STARTS)
    with closing(EchoFlightVector(config.evaluation.flights, config.arena)) as env:
        final, chosen = (env.reset(seed=seed) and env.poses.copy() for seed in seeds)
    distances_m = np.abs(final[:, None] - chosen[None]).max(axis=2)
    assert distances_m.min() > 0.0
