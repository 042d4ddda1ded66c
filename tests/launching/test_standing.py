"""How a run stands, from reports made by hand; and how it looks."""

import io

import pytest
from rich.console import Console

from apex_bat.config import Config, load
from apex_bat.launching.live import PlainView, TerminalView, figures
from apex_bat.launching.standing import Origin, Standing
from apex_bat.launching.supervisor import Watched
from apex_bat.roles.plan import Role, roles_of
from apex_bat.transport.messages import Report


def report(role: str, metrics: dict[str, float] | None = None, pid: int = 1, host: str = "here") -> Report:
    return Report(role, pid, host, "", "flying", metrics or {})


def standing_of(config: Config) -> Standing:
    standing = Standing(config, now_s=0.0)
    standing.now_s = 10.0
    return standing


def test_counters_add_up_over_actors_and_over_restarts() -> None:
    standing = standing_of(load(None, ["actors=2"]))
    standing.take(report("actor-0", {"env_steps": 100}), 1.0)
    standing.take(report("actor-1", {"env_steps": 10}), 1.0)
    standing.take(report("actor-0", {"env_steps": 150}), 2.0)
    standing.take(report("actor-0", {"env_steps": 7}, pid=2), 3.0)
    assert standing.env_steps == 167
    standing.take(report("actor-0", {"env_steps": 3}, pid=2, host="there"), 4.0)
    assert standing.env_steps == 170, "in containers process numbers are the same everywhere"


def test_time_runs_from_the_first_environment_step() -> None:
    standing = standing_of(load(None, ["train.max_minutes=1.0"]))
    standing.take(report("learner"), 2.0)
    assert standing.elapsed_s == 0.0
    standing.take(report("actor-0", {"env_steps": 5}), 4.0)
    standing.now_s = 34.0
    assert standing.elapsed_s == 30.0
    assert standing.time_left_s == pytest.approx(30.0)
    assert not standing.is_over
    standing.now_s = 64.0
    assert standing.is_over


def test_a_run_is_under_way_once_it_has_learnt_or_has_flown_for_a_while() -> None:
    learnt, flown = standing_of(Config()), standing_of(Config())
    for standing in (learnt, flown):
        standing.take(report("learner", {"learner_step": 0}), 10.0)
        assert not standing.is_under_way
        standing.take(report("actor-0", {"env_steps": 5}), 10.0)
        assert not standing.is_under_way
    learnt.take(report("learner", {"learner_step": 1}), 10.0)
    assert learnt.is_under_way
    flown.now_s = 16.0
    assert flown.is_under_way


def test_a_resumed_run_is_under_way_once_it_learns_more() -> None:
    standing = Standing(Config(), now_s=0.0, origin=Origin(updates=700.0))
    standing.take(report("actor-0", {"env_steps": 5}), 1.0)
    standing.take(report("learner", {"learner_step": 700}), 1.0)
    assert not standing.is_under_way
    standing.take(report("learner", {"learner_step": 701}), 1.0)
    assert standing.is_under_way


@pytest.mark.parametrize(
    ("limit", "role", "metrics"),
    [
        ("train.max_env_steps=100", "actor-0", {"env_steps": 100}),
        ("train.max_updates=7", "learner", {"learner_step": 7}),
    ],
)
def test_each_limit_ends_the_run(limit: str, role: str, metrics: dict[str, float]) -> None:
    standing = standing_of(load(None, [limit]))
    assert not standing.is_over
    standing.take(report(role, metrics), 1.0)
    assert standing.is_over


def test_mean_return_weighs_reports_by_their_episodes() -> None:
    standing = standing_of(Config())
    standing.take(report("actor-0", {"return": 1.0, "return_count": 1.0}), 1.0)
    standing.take(report("actor-1", {"return": 4.0, "return_count": 2.0}), 1.0)
    standing.take(report("evaluator", {"return": 40.0}), 1.0)  # of longer flights
    assert standing.recent("return") == pytest.approx(3.0)
    assert standing.recent("return_greedy") is None


def test_a_report_of_an_unknown_role_is_ignored() -> None:
    standing = standing_of(Config())
    standing.take(report("actor-77", {"env_steps": 5}), 1.0)
    assert standing.env_steps == 0


def watched_roles(config: Config) -> dict[str, Watched]:
    return {role.name: Watched(role) for role in roles_of(config)}


@pytest.mark.parametrize("width", [80, 160])
def test_the_view_fits_a_terminal_and_shows_every_figure(width: int) -> None:
    config = load(None, ["actors=4"])
    standing = standing_of(config)
    standing.take(report("actor-0", {"env_steps": 1_234_567, "env_steps_per_s": 1500.0, "episodes": 99_999}), 1.0)
    standing.take(report("learner", {"learner_step": 123_456, "updates_per_s": 100.0, "loss": 0.00012}), 1.0)
    output = io.StringIO()
    console = Console(file=output, force_terminal=True, width=width, height=24, color_system=None)
    with TerminalView(console, "apex-bat train") as view:
        view.show(standing, watched_roles(config))
    lines = output.getvalue().splitlines()
    assert max(len(line) for line in lines) <= width + 20  # cursor movements are not seen
    for name, value in figures(standing):
        assert name in output.getvalue()
        assert value in output.getvalue()
    assert all(role in output.getvalue() for role in ("actor-3", "learner", "replay", "evaluator"))


def test_plain_lines_come_every_ten_seconds_and_in_one_line_each() -> None:
    output = io.StringIO()
    standing = standing_of(Config())
    with PlainView(Console(file=output, width=80)) as view:
        for standing.now_s in (0.0, 5.0, 10.0, 19.0):
            view.show(standing, {})
    assert output.getvalue().count("\n") == 2


def test_the_newest_returns_of_actors_that_join_count_as_those_of_the_first() -> None:
    standing = standing_of(load(None, ["actors=1"]))
    for number in range(1, 4):
        standing.add(Role("actor", number))
    for value in range(120):
        standing.take(report("actor-0", {"return": float(value)}), 1.0)
    assert standing.recent("return") == pytest.approx(sum(range(120)) / 120), "30 reports for each of 4 actors"
