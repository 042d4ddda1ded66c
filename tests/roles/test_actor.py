"""An actor that was started late or restored goes on where the run stands."""

from __future__ import annotations

import threading
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest

from apex_bat.agent.exploration import annealed, choose_actions
from apex_bat.config import Config, load
from apex_bat.replay.store import ReplayStore
from apex_bat.roles import actor as actor_module
from apex_bat.roles.actor import Actor
from apex_bat.roles.learner import new_agent
from apex_bat.roles.plan import Addresses, Assignment, Role
from apex_bat.roles.reporting import RoleReporter
from apex_bat.roles.serial import BoardReader, StoreSink, WeightsBoard
from apex_bat.storage import State, part_of, read_arrays, write_arrays
from apex_bat.transport.messages import Report

SMALL = ("network.channels=[4]", "network.strides=[3]", "network.hidden=[8]", "bats_per_actor=3", "actors=2",
         "actor.chunk_transitions=10", "sonar.rendering=exact", "episode.training_steps=17", "rays.num_azimuth=12",
         "rays.num_elevation=2", "replay.min_size=500", "replay.capacity=500", "recording.every_episodes=0",
         "body.heading_noise_deg=2.0")  # fmt: skip


class Dropped:
    """Reports that nobody reads."""

    def send(self, report: Report) -> None:
        assert report.role == "actor-0"

    def close(self) -> None:
        return None


class Flying:
    """An actor and the replay that it fills."""

    def __init__(self, config: Config, stack: ExitStack, flown_steps: int = 0) -> None:
        assignment = Assignment(
            Role("actor", 0), config, Path(), Addresses("", "", ""), threading.Event(), 0, flown_steps, lambda: 0.0
        )
        self.store = ReplayStore(config, np.random.default_rng(0))
        board = WeightsBoard()
        board.publish(1, 0, new_agent(assignment).weights())
        reporter = RoleReporter(assignment, resources=dict, line=Dropped())
        made = Actor(assignment, StoreSink(self.store, "actor-0"), BoardReader(board), reporter)
        self.actor = stack.enter_context(closing(made))

    def fly(self, steps: int) -> None:
        for _ in range(steps):
            assert self.actor.is_ready(0.0)
            self.actor.step()


def lone_actor(config: Config, stack: ExitStack, incarnation: int, flown_steps: int, run: Path = Path()) -> Actor:
    """An actor whose learner has broadcast nothing yet."""
    stop, nowhere = threading.Event(), Addresses("", "", "")
    assignment = Assignment(Role("actor", 0), config, run, nowhere, stop, incarnation, flown_steps, lambda: 0.0)
    sink = StoreSink(ReplayStore(config, np.random.default_rng(0)), "actor-0")
    reporter = RoleReporter(assignment, resources=dict, line=Dropped())
    return stack.enter_context(closing(Actor(assignment, sink, BoardReader(WeightsBoard()), reporter)))


def test_an_actor_of_a_new_run_flies_before_there_is_a_learner_and_with_its_first_weights() -> None:
    config = load(None, [*SMALL, "seed=3"])
    with ExitStack() as stack:
        actor = lone_actor(config, stack, 0, 0)
        assert actor.is_ready(0.0)
        actor.step()
        _, flown_with = part_of(actor.state(), "parameters")
    first = new_agent(Assignment(Role("learner", 0), config, Path(), Addresses("", "", ""), threading.Event(), 0))
    for name, array in first.weights().items():
        np.testing.assert_array_equal(flown_with[name], array)


@pytest.mark.parametrize(("incarnation", "flown_steps"), [(1, 0), (0, 600)])
def test_an_actor_of_a_run_that_has_learnt_waits_for_its_learner(incarnation: int, flown_steps: int) -> None:
    with ExitStack() as stack:
        assert not lone_actor(load(None, list(SMALL)), stack, incarnation, flown_steps).is_ready(0.0)


def test_an_actor_that_was_told_nothing_sees_by_a_checkpoint_that_the_run_has_learnt(tmp_path: Path) -> None:
    config = load(None, list(SMALL))
    with ExitStack() as stack:
        assert lone_actor(config, stack, 0, 0, tmp_path).is_ready(0.0)
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / "step-000000007.npz").touch()
        assert not lone_actor(config, stack, 0, 0, tmp_path).is_ready(0.0)


def test_an_actor_that_is_held_back_keeps_saying_that_it_wants_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as stack:
        flying = Flying(load(None, SMALL), stack)
        flying.fly(1)
        waits: list[float] = []

        def wait(_: BoardReader, timeout_s: float) -> bool:
            waits.append(timeout_s)
            return False

        monkeypatch.setattr(BoardReader, "wait", wait)
        monkeypatch.setattr(StoreSink, "has_room", property(lambda _: False))
        assert not flying.actor.is_ready(0.0)
        assert waits == [0.0]


def epsilons_of(flown_steps: int, steps: int, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The epsilons with which an actor chose its actions."""
    used: list[float] = []

    def noting(q: np.ndarray, epsilons: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        used.append(float(epsilons[0]))
        return choose_actions(q, epsilons, generator)

    monkeypatch.setattr(actor_module, "choose_actions", noting)
    config = load(None, [*SMALL, "exploration.kind=anneal", "exploration.anneal_steps=1000"])
    with ExitStack() as stack:
        Flying(config, stack, flown_steps).fly(steps)
    return used


def test_annealing_goes_on_where_the_run_stood_when_the_actor_was_started(monkeypatch: pytest.MonkeyPatch) -> None:
    exploration = load(None, ["exploration.kind=anneal", "exploration.anneal_steps=1000"]).exploration
    assert epsilons_of(0, 3, monkeypatch) == [annealed(steps, exploration) for steps in (0, 6, 12)]
    assert epsilons_of(600, 3, monkeypatch) == [annealed(steps, exploration) for steps in (600, 606, 612)]


def test_a_restored_actor_makes_the_experience_that_it_would_have_made(tmp_path: Path) -> None:
    config = load(None, list(SMALL))
    with ExitStack() as stack:
        one, other = Flying(config, stack), Flying(config, stack)
        one.fly(43)
        before = one.store.buffer.counters
        state = one.actor.state()
        write_arrays(tmp_path / "state.npz", "state", {"values": state.values}, state.arrays)
        header, arrays = read_arrays(tmp_path / "state.npz", "state")
        other.actor.restore(State(header["values"], arrays))
        one.fly(40)
        other.fly(40)
        rows, items = one.store.buffer.counters.next_row, one.store.buffer.counters.next_item
        assert items - before.next_item == other.store.buffer.counters.next_item > 60
        new = {name: values[before.next_row : rows] for name, values in one.store.buffer.row_arrays().items()}
        for name, values in other.store.buffer.row_arrays().items():
            np.testing.assert_array_equal(values[: rows - before.next_row], new[name], err_msg=name)
        for name in ("reward", "discount", "priority", "span"):
            expected = one.store.buffer.item_arrays()["items"][name][before.next_item : items]
            got = other.store.buffer.item_arrays()["items"][name][: items - before.next_item]
            np.testing.assert_array_equal(got, expected, err_msg=name)
