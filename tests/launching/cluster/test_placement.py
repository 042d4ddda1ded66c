"""What roles ask of a cluster, and what is said when it is not there."""

from pathlib import Path

import pytest

from apex_bat.config import Config, load
from apex_bat.launching.cluster.placement import (
    Resources,
    as_text,
    core_roles,
    demand_of,
    num_places,
    num_places_beside,
    reserved_roles,
    shortage,
)
from apex_bat.roles.plan import Role

REPLAY, LEARNER, ACTOR, EVALUATOR = Role("replay", 0), Role("learner", 0), Role("actor", 0), Role("evaluator", 0)


def asked(role: Role, *settings: str, has_gpu: bool = False) -> Resources:
    return demand_of(role, load(None, settings), has_gpu)


@pytest.mark.parametrize(
    ("setting", "role", "name", "amount"),
    [
        ("cluster.role_cpus=0.5", ACTOR, "CPU", 0.5),
        ("cluster.role_cpus=0.5", REPLAY, "CPU", 0.5),
        ("cluster.role_cpus=0.5", EVALUATOR, "CPU", 0.5),
        ("train.threads=4", LEARNER, "CPU", 4.0),
        ("cluster.learner_gpus=0.25", LEARNER, "GPU", 0.25),
        ("cluster.replay_memory_gb=7.0", REPLAY, "memory", 7e9),
        ("replay.capacity=10_000_000", REPLAY, "memory", 6.5e9),
        ("cluster.learner_resource=gpu_box", LEARNER, "gpu_box", 1.0),
        ("cluster.replay_resource=big", REPLAY, "big", 1.0),
        ("cluster.actor_resource=small", ACTOR, "small", 1.0),
    ],
)
def test_each_setting_changes_what_a_role_asks_for(setting: str, role: Role, name: str, amount: float) -> None:
    assert asked(role, setting)[name] == pytest.approx(amount)
    assert asked(role).get(name) != pytest.approx(amount)


def test_the_learner_asks_for_a_gpu_where_there_is_one_and_may_use_it() -> None:
    assert asked(LEARNER, has_gpu=True)["GPU"] == 1.0
    assert "GPU" not in asked(LEARNER, has_gpu=False)
    assert "GPU" not in asked(LEARNER, "device=cpu", has_gpu=True)
    assert "GPU" not in asked(ACTOR, has_gpu=True)


def test_every_role_asks_for_something_or_ray_would_put_it_anywhere() -> None:
    for role in (REPLAY, LEARNER, ACTOR, EVALUATOR):
        assert asked(role)["CPU"] > 0.0
    with pytest.raises(ValueError, match="role_cpus"):
        load(None, ["cluster.role_cpus=0"])


def test_actors_may_come_and_go_and_the_others_may_not() -> None:
    assert core_roles(Config()) == [REPLAY, LEARNER, EVALUATOR]
    assert reserved_roles(Config()) == [REPLAY, LEARNER, EVALUATOR, ACTOR], "without one actor nothing would begin"


def test_room_is_counted_node_by_node() -> None:
    nodes: list[Resources] = [{"CPU": 3.0}, {"CPU": 1.5, "memory": 1e9}]
    assert num_places({"CPU": 1.0}, nodes) == 4
    assert num_places({"CPU": 2.0}, nodes) == 1, "not 4.5 CPU together"
    assert num_places({"CPU": 0.1}, nodes, most=7) == 7
    assert num_places_beside([{"CPU": 2.0}, {"CPU": 1.0, "memory": 1e9}], {"CPU": 0.5}, nodes) == 3
    assert num_places_beside([{"GPU": 1.0}], {"CPU": 1.0}, nodes) == 4, "who has no place takes none"
    assert nodes[0] == {"CPU": 3.0}, "what is given stays as it is"


def test_a_shortage_names_what_is_asked_and_what_there_is() -> None:
    text = shortage({"learner": {"CPU": 1.0, "GPU": 1.0}}, [{"CPU": 2.0, "node:10.0.0.1": 1.0, "memory": 4e9}])
    assert text == "asked: learner: 1 CPU, 1 GPU. There is: 2 CPU, 4 GB memory"
    assert "and 2 more nodes" in shortage({}, [{"CPU": 1.0}] * 10)
    assert as_text({}) == "nothing"


def test_actors_auto_is_a_number_in_the_settings_of_the_run(tmp_path: Path) -> None:
    given: list[Config] = []

    def ten(config: Config) -> int:
        given.append(config)
        return 10

    config = load(None, ["actors=auto", "cluster.role_cpus=2"], ten, can_grow=True)
    assert (config.actors, config.cluster.grow) == (10, True)
    assert given[0].cluster.role_cpus == 2.0, "the other settings are known when actors are counted"
    file = tmp_path / "c.toml"
    file.write_text('actors = "auto"\n')
    assert load(file, (), lambda _: 3).actors == 3
    assert not load(file, (), lambda _: 3).cluster.grow
    assert not load(None, ["actors=4"]).cluster.grow
