"""What the launcher says and asks of Ray, without a cluster; `test_runs_on_ray` has one."""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import socket
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pytest

pytest.importorskip("ray")

from apex_bat.cli.checking import check
from apex_bat.config import Config, ConfigError, load
from apex_bat.config.settings import MOST_ACTORS
from apex_bat.launching.cluster import ray_cluster as module
from apex_bat.launching.cluster import ray_keepers
from apex_bat.launching.cluster.placement import ClusterError, Resources
from apex_bat.launching.cluster.ray_cluster import connected, num_actor_places
from apex_bat.launching.cluster.ray_keepers import RayPlacer
from apex_bat.roles.plan import Role


@dataclass
class Ray:
    """What Ray says of a cluster."""

    nodes: list[Resources]
    free: Resources


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> Ray:
    one = Ray([{"CPU": 4.0, "memory": 1e10}, {"CPU": 3.0, "memory": 1e10}], {"CPU": 2.0})
    monkeypatch.setattr(module, "_all_nodes", lambda: [{"Alive": True, "Resources": node} for node in one.nodes])
    monkeypatch.setattr(module, "_free", lambda: one.free)
    return one


@dataclass
class FakeFleet:
    """Says whether a role waits for a place."""

    is_waiting: bool = False


def growth(*settings: str, fleet: FakeFleet | None = None) -> Any:
    return module._Growth(load(None, ["actors=3", *settings]), fleet or FakeFleet())  # type: ignore[arg-type]


def test_actors_are_added_while_there_is_room_and_the_settings_say_so(ray: Ray) -> None:
    grown = growth("cluster.grow=true")
    assert [role.name for role in grown.more()] == ["actor-3", "actor-4"]
    ray.free = {"CPU": 1.5}
    assert [role.name for role in grown.more()] == ["actor-5"]
    ray.free = {"CPU": 0.5}
    assert grown.more() == []
    assert growth("cluster.grow=false").more() == []


def test_no_actor_is_added_while_one_waits_for_a_place(ray: Ray) -> None:
    del ray
    assert growth("cluster.grow=true", fleet=FakeFleet(is_waiting=True)).more() == []


def test_a_huge_cluster_is_filled_in_steps_and_not_beyond_the_most(ray: Ray) -> None:
    ray.free = {"CPU": 1e6}
    grown, number = growth("cluster.grow=true"), 3
    while more := grown.more():
        assert len(more) <= module._MOST_AT_ONCE
        number += len(more)
    assert number == MOST_ACTORS


def test_auto_counts_places_beside_the_other_roles(ray: Ray) -> None:
    assert num_actor_places(Config()) == 4, "7 CPU, and 3 for replay, learner and evaluator"
    assert num_actor_places(load(None, ["cluster.role_cpus=0.5"])) == 10
    ray.nodes = [{"CPU": 1.0}]
    assert num_actor_places(Config()) == 1


def test_the_learner_gets_a_gpu_of_a_cluster_that_has_one(ray: Ray) -> None:
    assert not module._has_gpu(module._nodes())
    ray.nodes.append({"CPU": 1.0, "GPU": 1.0})
    assert module._has_gpu(module._nodes())


def test_what_roles_ask_stays_what_their_places_hold_when_nodes_come_and_go(
    ray: Ray, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[list[Resources]] = []
    monkeypatch.setattr(module, "placement_group", lambda bundles, **_: asked.append(bundles))
    monkeypatch.setattr(module, "_await_places", lambda *_: None)
    config = Config()
    with module._places(config) as (group, demands):
        assert list(demands) == ["replay", "learner", "evaluator", "actor-0"], "without an actor nothing would begin"
        assert asked == [list(demands.values())]
        placer = RayPlacer(config, tmp_path, "m", group, demands)
        before = placer.asks(Role("learner", 0))
        ray.nodes.append({"CPU": 1.0, "GPU": 1.0})
        assert placer.asks(Role("learner", 0)) == before == "1 CPU"
        assert placer.asks(Role("actor", 0)) == placer.asks(Role("actor", 9)) == "1 CPU"


@pytest.mark.parametrize(("status", "waits"), [(None, False), ({"ended": True}, False), ({"ended": False}, True)])
def test_what_a_former_launcher_may_have_left_running_is_waited_for(
    status: dict[str, bool] | None, waits: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept_s: list[float] = []
    monkeypatch.setattr(time, "sleep", slept_s.append)
    if status is not None:
        facts = {"launcher_pid": 1, "host": "elsewhere", "written_unix_s": 0.0, "roles": []}
        (tmp_path / "status.json").write_text(json.dumps(facts | status))
    for lease_s, wait_s in ((20.0, 21.5), (2.0, 3.5)):
        module._await_leases(load(None, [f"cluster.lease_s={lease_s}"]), tmp_path)
        assert slept_s == ([wait_s] if waits else [])
        slept_s.clear()


def test_a_damaged_status_does_not_say_that_the_run_has_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slept_s: list[float] = []
    monkeypatch.setattr(time, "sleep", slept_s.append)
    (tmp_path / "status.json").write_text("{")
    module._await_leases(Config(), tmp_path)
    assert slept_s


def test_a_node_is_removed_or_refusing_or_nothing_is_known_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as listening, socket.socket() as closed:
        for one in (listening, closed):
            one.bind(("127.0.0.1", 0))
        listening.listen()
        closed_port = closed.getsockname()[1]
        closed.close()
        ports = {"well": listening.getsockname()[1], "dead": closed_port, "counted out": closed_port}
        nodes = [
            {"NodeID": name, "Alive": name != "counted out", "NodeManagerAddress": "127.0.0.1", "NodeManagerPort": port}
            for name, port in ports.items()
        ]
        monkeypatch.setattr(ray_keepers, "_nodes", lambda: nodes)
        placer = RayPlacer(Config(), tmp_path, "m", None, {})  # type: ignore[arg-type]
        assert placer.fates([*ports, "forgotten"]) == {
            "well": "unknown", "dead": "refusing", "counted out": "removed", "forgotten": "removed",
        }  # fmt: skip
        assert placer.fates([]) == {}


def test_nodes_that_swallow_every_packet_are_asked_together_and_not_for_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def swallowed(*_: object) -> None:
        await asyncio.sleep(60.0)

    monkeypatch.setattr(asyncio, "open_connection", swallowed)
    nodes = [{"NodeID": f"{i}", "Alive": True, "NodeManagerAddress": "h", "NodeManagerPort": i} for i in range(50)]
    monkeypatch.setattr(ray_keepers, "_nodes", lambda: nodes)
    placer = RayPlacer(Config(), tmp_path, "m", None, {})  # type: ignore[arg-type]
    begun_s = time.monotonic()
    assert set(placer.fates([node["NodeID"] for node in nodes]).values()) == {"unknown"}  # type: ignore[misc]
    assert time.monotonic() - begun_s < 5.0


def test_the_number_of_an_error_of_a_keeper_comes_along() -> None:
    from ray.exceptions import RayTaskError

    def raised(cause: Exception) -> Exception:
        text = f"traceback\n{type(cause).__name__}: {cause}"
        return ray_keepers._raised(RayTaskError("start", text, cause))  # type: ignore[no-untyped-call]

    denied = raised(PermissionError(errno.EACCES, "Permission denied"))
    assert isinstance(denied, OSError)
    assert denied.errno == errno.EACCES
    assert "Permission denied" in str(denied)
    none_free = raised(OSError("none of the ports is free"))
    assert isinstance(none_free, OSError)
    assert none_free.errno is None
    assert not isinstance(raised(ValueError("x")), OSError)


class NoPlace:
    """A placement group that is never ready."""

    def wait(self, timeout_s: float) -> bool:
        del timeout_s
        return False


def test_waiting_for_a_place_is_said_and_ends_after_the_time_that_is_set(
    ray: Ray, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    del ray
    monkeypatch.setattr(module, "_QUIET_S", 0.0)
    demands = {"learner": {"CPU": 16.0}}
    for wait_s in (0.01, 0.02):
        config = load(None, [f"cluster.wait_s={wait_s}"])
        with caplog.at_level(logging.WARNING), pytest.raises(ClusterError, match=f"within {wait_s:g} s") as failed:
            module._await_places(NoPlace(), demands, config)  # type: ignore[arg-type]
        assert "asked: learner: 16 CPU. There is: 4 CPU" in str(failed.value)
        assert "Free of it: 2 CPU" in str(failed.value)
    assert "waits for a place in the cluster" in caplog.text


def test_a_launcher_outside_the_cluster_is_refused() -> None:
    with pytest.raises(ClusterError, match="must run on a node of the cluster"), connected("ray://10.0.0.1:10001"):
        pass


def test_an_address_to_listen_at_is_refused_because_each_node_has_its_own() -> None:
    config = load(None, ["transport.host=127.0.0.1"])
    check(config)
    with pytest.raises(ConfigError, match=r"transport\.host: on a cluster"):
        check(config, on_cluster=True)


def test_every_setting_of_the_cluster_is_tested_somewhere() -> None:
    tested = {
        "role_cpus", "learner_gpus", "replay_memory_gb", "learner_resource", "replay_resource", "actor_resource",
        "grow", "wait_s", "lease_s",
    }  # fmt: skip
    assert {field.name for field in msgspec.structs.fields(type(Config().cluster))} == tested


def test_what_ray_prints_of_dying_nodes_is_one_line_in_the_log(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level(logging.INFO):
        module._note({"lines": ["\na node died\n" + "state dump\n" * 200], "pid": "raylet"}, ignore_prefix=False)
    assert [record.getMessage() for record in caplog.records] == ["Ray: a node died"]
    assert capsys.readouterr().out == ""
    from ray._private import worker

    assert hasattr(worker, "print_to_stdstream"), "what is replaced is still there in this Ray"
