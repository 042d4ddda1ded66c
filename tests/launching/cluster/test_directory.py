"""Endpoints that move: who is told what, and that each life has another generation."""

from apex_bat.launching.cluster.directory import Directory
from apex_bat.roles.plan import Role

LEARNER, ACTOR, EVALUATOR = Role("learner", 0), Role("actor", 3), Role("evaluator", 0)


def test_a_role_waits_for_the_servers_that_it_needs() -> None:
    directory, replay = Directory("tcp://10.0.0.1:1", 1), Role("replay", 0)
    assert directory.addresses_for(EVALUATOR, 7) is not None
    assert directory.addresses_for(replay, 7) is None
    directory.settle(replay, "tcp://10.0.0.2:2")
    assert directory.addresses_for(replay, 7) is not None
    assert directory.addresses_for(ACTOR, 7) is None, "nobody broadcasts weights yet"
    directory.settle(LEARNER, "tcp://10.0.0.3:3")
    for role in (ACTOR, LEARNER):
        found = directory.addresses_for(role, 7)
        assert found is not None
        assert (found.replay, found.weights, found.reports) == (
            "tcp://10.0.0.2:2", "tcp://10.0.0.3:3", "tcp://10.0.0.1:1"
        )  # fmt: skip
        assert found.reports_generation == 7


def test_each_life_of_a_server_has_another_generation_and_counts_as_news() -> None:
    directory, replay = Directory("tcp://10.0.0.1:1", 1), Role("replay", 0)
    directory.settle(LEARNER, "tcp://10.0.0.3:3")
    directory.settle(replay, "tcp://10.0.0.2:2")
    before, version = directory.addresses_for(ACTOR, 0), directory.version
    directory.settle(replay, "tcp://10.0.0.2:2")
    after = directory.addresses_for(ACTOR, 0)
    assert before is not None
    assert after is not None
    assert directory.version > version
    assert before.replay_generation != after.replay_generation, "although it listens at the same place"
    assert before.weights_generation == after.weights_generation
    directory.settle(ACTOR, "tcp://10.0.0.9:9")
    assert directory.version == version + 1, "nobody connects to an actor"


def test_all_servers_that_share_the_replay_are_named_in_their_order() -> None:
    directory, shards = Directory("tcp://10.0.0.1:1", 2), [Role("replay", i, 2) for i in range(2)]
    directory.settle(LEARNER, "tcp://10.0.0.3:3")
    directory.settle(shards[1], "tcp://10.0.0.5:5")
    assert directory.addresses_for(ACTOR, 0) is None
    assert directory.addresses_for(shards[1], 0) is not None
    directory.settle(shards[0], "tcp://10.0.0.4:4")
    found = directory.addresses_for(ACTOR, 0)
    assert found is not None
    assert found.replays == ["tcp://10.0.0.4:4", "tcp://10.0.0.5:5"]
    assert len(set(found.replay_generations)) == 2
