"""An actor's recording: of which bat, which episodes, and without any effect on the flight."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np

from apex_bat.agent.exploration import ladder_of_actor
from apex_bat.config import load
from apex_bat.experience import Chunk
from apex_bat.recording.catalog import list_flights
from apex_bat.recording.reading import read_flight
from apex_bat.roles.actor import Actor
from apex_bat.roles.plan import Role
from apex_bat.roles.reporting import RoleReporter
from tests.roles.fakes import LEARNER_STEP, FakeReplay, FakeWeights, assignment

SMALL = ("network.channels=[4]", "network.strides=[3]", "network.hidden=[8]", "bats_per_actor=3", "actors=2",
         "actor.chunk_transitions=10", "sonar.rendering=exact", "episode.training_steps=12")  # fmt: skip


def fly(folder: Path, *changes: str, number: int = 0, steps: int = 40) -> list[Chunk]:
    """The chunks of some steps of an actor."""
    config = load(None, [*SMALL, *changes])
    whole, replay = assignment(config, folder, Role("actor", number)), FakeReplay()
    with closing(RoleReporter(whole)) as reporter:
        actor = Actor(whole, replay, FakeWeights(config), reporter)
        with closing(actor):
            for _ in range(steps):
                assert actor.is_ready(0.0)
                actor.step()
    return replay.chunks


def test_recording_changes_nothing_in_the_flight(tmp_path: Path) -> None:
    without = fly(tmp_path, "recording.every_episodes=0")
    recorded = fly(tmp_path, "recording.every_episodes=1")
    assert len(list_flights(tmp_path)) >= 3
    for one, other in zip(without, recorded, strict=True):
        for name, left, right in zip(one._fields, one, other, strict=True):
            np.testing.assert_array_equal(left, right, err_msg=name)


def test_recorded_flight_is_the_one_that_trains(tmp_path: Path) -> None:
    chunks = fly(tmp_path, "recording.every_episodes=1")
    flight = read_flight(list_flights(tmp_path)[0].path)
    assert (flight.facts.kind, flight.facts.actor, flight.facts.checkpoint_step) == ("training", 0, LEARNER_STEP)
    assert any(
        chunk.first_step == 0
        and len(chunk.frames) >= flight.num_steps
        and np.array_equal(chunk.frames[: flight.num_steps], flight.frame)
        and np.array_equal(chunk.actions[: flight.num_steps], flight.action)
        for chunk in chunks
    )


def test_every_nth_episode_of_the_least_exploring_bat_is_recorded(tmp_path: Path) -> None:
    fly(tmp_path, "recording.every_episodes=2")
    entries = list_flights(tmp_path)
    assert [entry.episode for entry in entries] == list(range(1, 2 * len(entries), 2)), "the second, the fourth, ..."
    config = load(None, list(SMALL))
    epsilons = ladder_of_actor(0, config.actors, config.bats_per_actor, config.exploration)
    assert read_flight(entries[0].path).facts.epsilon == epsilons.min()


def test_only_chosen_actors_record(tmp_path: Path) -> None:
    fly(tmp_path, "recording.every_episodes=1", number=1)
    assert not (tmp_path / "recordings").exists()
    fly(tmp_path, "recording.every_episodes=1", "recording.actors=[1]", number=1)
    assert {read_flight(entry.path).facts.actor for entry in list_flights(tmp_path)} == {1}


def test_heavy_entities_come_at_every_nth_step(tmp_path: Path) -> None:
    fly(tmp_path, "recording.every_episodes=1", "recording.heavy_period_steps=3")
    flight = read_flight(list_flights(tmp_path)[0].path)
    assert flight.heavy_steps.tolist() == list(range(0, flight.num_steps, 3))
