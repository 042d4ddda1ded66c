"""A learner that goes on from its checkpoint does what it would have done: the same losses on the same batches."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from apex_bat.config import Config, load
from apex_bat.roles import checkpoint
from apex_bat.roles.learner import Learner, make_agent, new_agent
from apex_bat.roles.plan import Addresses, Assignment, Role
from apex_bat.roles.reporting import RoleReporter
from apex_bat.roles.serial import WeightsBoard
from apex_bat.storage import digest
from apex_bat.transport.messages import Report
from tests.roles.fakes import Batches

SMALL = ("network.channels=[4]", "network.strides=[3]", "network.hidden=[8]", "learner.batch_size=16",
         "learner.target_period=30", "learner.learning_rate=0.005")  # fmt: skip


class Reports:
    """Keeps the losses that are reported."""

    def __init__(self) -> None:
        self.losses: list[float] = []

    def send(self, report: Report) -> None:
        self.losses.append(report.metrics["loss"])

    def close(self) -> None:
        return None


def losses(learner: Learner, reports: Reports, updates: int) -> list[float]:
    reports.losses.clear()
    for _ in range(updates):
        assert learner.step(0.0)
        learner.report("learning")
    return reports.losses.copy()


def make(
    folder: Path, config: Config, number: int, version: int | None, clock: Callable[[], float] = lambda: 0.0
) -> tuple[Learner, Reports, WeightsBoard]:
    assignment = Assignment(
        Role("learner", 0), config, folder, Addresses("", "", ""), threading.Event(), 0, clock=clock
    )
    reports, board = Reports(), WeightsBoard()
    agent, found = (new_agent(assignment), version) if version is not None else make_agent(assignment)
    reporter = RoleReporter(assignment, resources=dict, line=reports)
    return Learner(assignment, agent, found, Batches(number), board, reporter), reports, board


@pytest.mark.parametrize(
    "changes", [(), ("learner.optimiser=adam", "network.dropout=0.3"), ("learner.target_period=0",)]
)
def test_the_next_hundred_losses_are_those_without_interruption(changes: tuple[str, ...], tmp_path: Path) -> None:
    config = load(None, [*SMALL, *changes])
    learner, reports, _ = make(tmp_path, config, 0, version=0)
    losses(learner, reports, 77)
    (tmp_path / "checkpoints").mkdir()
    learner.save()
    expected = losses(learner, reports, 100)
    resumed, resumed_reports, board = make(tmp_path, config, 77, version=None)
    assert board.newest is not None
    assert (board.newest.version, board.newest.learner_step) == (5, 77), "1 at the start, 3 in 77 updates, and 1 more"
    assert losses(resumed, resumed_reports, 100) == expected
    assert len(set(expected)) == 100


def test_a_state_holds_what_a_checkpoint_holds_and_the_counters(tmp_path: Path) -> None:
    config = load(None, list(SMALL))
    learner, reports, _ = make(tmp_path, config, 0, version=0)
    losses(learner, reports, 40)
    state = learner.state()
    (tmp_path / "checkpoints").mkdir()
    learner.save()
    found = checkpoint.load_newest(tmp_path / "checkpoints")
    assert found is not None
    own = {name.removeprefix("self/"): array for name, array in state.arrays.items()}
    assert digest(own) == digest(found.arrays)
    expected = losses(learner, reports, 20)
    other, other_reports, _ = make(tmp_path, config, 40, version=9)
    other.restore(state)
    assert losses(other, other_reports, 20) == expected
    assert other.num_updates == 60


def test_checkpoints_come_by_the_clock_of_the_assignment(tmp_path: Path) -> None:
    now_s = [0.0]
    (tmp_path / "checkpoints").mkdir()
    learner, reports, _ = make(
        tmp_path, load(None, [*SMALL, "checkpoint.period_s=10"]), 0, version=0, clock=lambda: now_s[0]
    )
    losses(learner, reports, 5)
    assert checkpoint.find(tmp_path / "checkpoints") == []
    now_s[0] = 10.0
    assert learner.step(0.0)
    assert [checkpoint.step_of(path) for path in checkpoint.find(tmp_path / "checkpoints")] == [6]
