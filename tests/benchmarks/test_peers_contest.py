"""The contest runs everything once, seeds interleaved, keeps what is done, and adds up what processes use."""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from apex_bat.config import load
from apex_bat.roles import checkpoint
from benchmarks.peers import apex_bat_entry, contest
from benchmarks.peers.contest import Options, PeerError, Start, hold, result_of, starts
from benchmarks.peers.judging import Judgement
from benchmarks.peers.notebook import Notebook, Row
from benchmarks.peers.process_tree import ProcessTree, Sample
from benchmarks.peers.terms import ABLATIONS, ENTRIES, entry_of, epsilon_at, terms, updates_of
from benchmarks.peers.training import Task


def options(tmp_path: Path, **changes: Any) -> Options:
    made = Options(tmp_path / "peers.json", {"registered": 60.0, "obvious": 90.0}, 10.0)
    return made._replace(**changes)


def test_seeds_are_interleaved_and_apex_bat_flies_the_registered_environment_only() -> None:
    order = starts(ENTRIES, ("registered", "obvious"), 2)
    assert [start.seed for start in order] == [0] * 7 + [1] * 7
    assert [start.entry.name for start in order[:7]] == [
        "apex_bat", "tianshou", "sb3", "rllib", "tianshou", "sb3", "rllib",
    ]  # fmt: skip
    assert len({start.name for start in order}) == len(order)


def test_results_of_other_settings_are_not_mixed_with_those_of_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contest, "run", made_up)
    order = starts([entry_of("sb3")], ("registered",), 2)
    list(hold(order[:1], options(tmp_path)))
    monkeypatch.setattr(contest, "terms", lambda: load(None, ["learner.target_period=7"]))
    with pytest.raises(PeerError, match="holds results of other settings"):
        list(hold(order, options(tmp_path)))
    assert len(contest.load(tmp_path / "peers.json")["results"]) == 1


def test_what_is_done_is_not_run_again_and_a_failure_stops_nobody_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[str] = []

    def run(start: Start, given: Options) -> dict[str, Any]:
        ran.append(start.name)
        if start.entry.name == "sb3" and len(ran) < 4:
            raise PeerError("no luck")
        return made_up(start, given)

    monkeypatch.setattr(contest, "run", run)
    order = starts([entry_of("tianshou"), entry_of("sb3"), entry_of("rllib")], ("registered",), 1)
    lines = list(hold(order, options(tmp_path)))
    assert ran == [start.name for start in order]
    assert [": failed: " in line for line in lines] == [False, True, False]
    assert [result["entry"] for result in contest.load(tmp_path / "peers.json")["results"]] == ["tianshou", "rllib"]
    list(hold(order, options(tmp_path)))
    assert ran[3:] == [order[1].name], "only what failed"
    assert len(contest.load(tmp_path / "peers.json")["results"]) == 3
    list(hold(order, options(tmp_path, budgets_s={"registered": 30.0, "obvious": 30.0})))
    assert len(ran) == 7, "another budget is another result"
    list(hold(order[:1], options(tmp_path, overrides=("adam=1",))))
    assert len(ran) == 8, "and so are other settings"


def made_up(start: Start, given: Options) -> dict[str, Any]:
    rows = [Row(3.0, 0, 0), Row(10.0, 1000, 0, "a"), Row(20.0, 3000, 100, "b"), Row(40.0, 9000, 700, "c")]
    samples = [Sample(0.0, 0.0, 100.0), Sample(20.0, 30.0, 500.0), Sample(40.0, 50.0, 400.0)]
    return result_of(
        start, given, rows, samples, {10.0: Judgement(0, 3.04), 20.0: Judgement(14, 150.0)}, {"numpy": "2"}
    )


def test_rates_are_of_the_time_in_which_it_learns_and_cpu_time_is_that_of_each_moment(tmp_path: Path) -> None:
    result = made_up(Start(entry_of("rllib"), "registered", 3), options(tmp_path))
    assert result["steps_per_s"] == pytest.approx(300.0)
    assert result["updates_per_s"] == pytest.approx(30.0)
    assert result["memory_mb"] == 500.0
    assert result["start_s"] == 3.0
    assert [point["cpu_s"] for point in result["curve"]] == [15.0, 30.0, 50.0]
    assert [point["completed"] for point in result["curve"]] == [0, 14, None]
    assert [point["progress_m"] for point in result["curve"]] == [3.0, 150.0, None]
    assert json.loads(json.dumps(result)) == result


def test_an_environment_of_a_library_that_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contest, "PEERS", tmp_path)
    with pytest.raises(PeerError, match="make peers"):
        contest.run(Start(entry_of("sb3"), "registered", 0), options(tmp_path))


def test_an_unknown_entry_is_named_beside_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"'acme'; there are apex_bat, tianshou"):
        entry_of("acme")


def test_a_tree_counts_children_and_what_they_used_after_they_ended() -> None:
    """The parent starts a child that computes, and itself only waits until its input ends."""
    child = "import time\nwhile time.process_time() < 0.5: pass\n"
    parent = (
        f"import subprocess, sys\nchild = subprocess.Popen([sys.executable, '-c', {child!r}], stdin=-3)  # no input\n"
        "sys.stdin.read()\nchild.wait()\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdin=subprocess.PIPE) as process:
        tree = ProcessTree(process.pid)
        deadline_s = time.monotonic() + 60.0
        while tree.look(0.0).cpu_s < 0.4 and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert tree.samples[-1].memory_mb > 5.0
        process.communicate(timeout=60.0)
    assert tree.look(1.0).cpu_s >= 0.4
    assert tree.samples[-1].memory_mb == 0.0
    tree.end(0.0)


def test_apex_bat_is_started_with_settings_that_it_knows(tmp_path: Path) -> None:
    for entry in (entry_of("apex_bat"), *ABLATIONS):
        command = apex_bat_entry.command(entry, 5, tmp_path, budget_s=60.0, every_s=10.0)
        overrides = [command[place + 1] for place, word in enumerate(command) if word == "--set"]
        config = load(Path(command[command.index("--config") + 1]), overrides)
        assert config.seed == 5
        assert config.checkpoint.period_s == 10.0
        assert config.train.max_minutes is not None
        assert config.train.max_minutes > 2.0, "the contest ends it, not this"
        bare = entry.name == "apex_bat_bare"
        assert (config.learner.mirror, config.learner.averaged_updates > 0) == (not bare, not bare)
        assert ("--serial" in command) == (entry.name == "apex_bat_serial")


def test_rows_of_apex_bat_are_its_checkpoints_with_the_steps_of_their_moment(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "metrics").mkdir()
    config = load(None)
    begin_unix_s = 1000.0
    for step, written_s in ((100, 1010.0), (300, 1030.0)):
        made = checkpoint.Checkpoint(step, checkpoint.fingerprint(config), {}, {})
        path = checkpoint.save(run / "checkpoints", made, keep=10)
        set_time(path, written_s)
    rows = [
        {"unix_s": 1000.0 + second, "elapsed_s": max(0.0, second - 7.0), "env_steps_total": 50.0 * second}
        for second in range(0, 60, 4)
    ]
    (run / "metrics" / "learner.jsonl").write_text("\n".join(json.dumps(row) for row in rows) + "\n")
    found = apex_bat_entry.rows(tmp_path, begin_unix_s)
    assert [row[:3] for row in found] == [(4.0, 0, 0), (10.0, 500, 100), (30.0, 1500, 300)]
    assert not found[0].policy
    assert (tmp_path / found[1].policy).exists()
    assert apex_bat_entry.rows(tmp_path / "elsewhere", begin_unix_s) == []


def set_time(path: Path, unix_s: float) -> None:
    import os

    os.utime(path, (unix_s, unix_s))


def test_the_peers_learn_as_often_as_apex_bat_and_explore_less_and_less() -> None:
    assert updates_of(16, terms()) == pytest.approx(2.0)
    assert [epsilon_at(steps) for steps in (0, 10_000, 20_000, 90_000)] == pytest.approx([1.0, 0.525, 0.05, 0.05])


def test_a_trial_changes_settings_of_a_peer_and_none_that_it_does_not_have(tmp_path: Path) -> None:
    def task(**overrides: float) -> Task:
        return Task("registered", 0, terms(), Notebook(tmp_path, terms(), 0.0, 1.0, 1.0), tmp_path, overrides)

    shared = task().settings()
    assert shared["learning_rate"] == terms().learner.learning_rate
    assert shared["target_period"] == terms().learner.target_period
    assert task(adam=1.0, runners=1.0).settings({"runners": 2.0}) == shared | {"adam": 1.0, "runners": 1.0}
    with pytest.raises(ValueError, match="no setting runners; there are threads, bats, adam, learning_rate"):
        task(runners=1.0).settings()
