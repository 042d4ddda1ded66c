"""The page and the picture of the contest, from made-up results."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.peers import report
from benchmarks.peers.figure import draw, on_grid
from benchmarks.peers.report import FILE, document, goal, groups, load_trials, reached, spread, summary, table

ROOT = Path(__file__).parents[2]
NEVER = float("inf")


def result(entry: str, environment: str, seed: int, curve: list[tuple[float, int | None]]) -> dict[str, Any]:
    return {
        "entry": entry, "environment": environment, "seed": seed, "budget_s": 600.0, "every_s": 10.0, "overrides": [],
        "start_s": 4.0,
        "commit": "abc", "ended": "2026-11-22T10:00:00+00:00", "versions": {"torch": "2.13.0"}, "steps_per_s": 400.0,
        "updates_per_s": 50.0, "memory_mb": 800.0,
        "curve": [
            {
                "wall_s": s, "env_steps": int(100 * s), "updates": int(10 * s), "cpu_s": 2 * s, "completed": completed,
                "progress_m": 150.0,
            }
            for s, completed in curve
        ],
    }  # fmt: skip


def at(entry: str, environment: str, *walls_s: float) -> list[dict[str, Any]]:
    """Returns a result for each seed that reaches 14 at a time, or never."""
    return [
        result(entry, environment, seed, [(10.0, 0), (wall_s, 14), (600.0, 12)] if wall_s < NEVER else [(600.0, 5)])
        for seed, wall_s in enumerate(walls_s)
    ]


RESULTS = [
    *at("apex_bat", "registered", 100.0, 90.0, 120.0), *at("tianshou", "registered", 200.0, 400.0, 300.0),
    *at("sb3", "registered", NEVER, 250.0, NEVER), *at("tianshou", "obvious", NEVER, NEVER, 500.0),
]  # fmt: skip
TERMS = {
    "learner": {
        "batch_size": 32, "discount": 0.9, "num_step": 2, "target_period": 77, "learning_rate": 0.003,
        "gradient_clip": 9.0,
    },
    "replay": {"capacity": 5_000, "min_size": 100, "samples_per_insert": 4.0, "alpha": 0.5, "beta": 0.3},
}  # fmt: skip
MACHINE = {"processor": "a core", "cores": 2, "python": "3.11"}


def test_a_training_has_reached_it_at_the_first_policy_that_completes_enough() -> None:
    made = result("sb3", "registered", 0, [(10.0, 3), (20.0, None), (30.0, 14), (40.0, 15)])
    assert reached(made) == (30.0, 3000.0, 300.0, 60.0, 150.0)
    assert reached(result("sb3", "registered", 0, [(10.0, 13)])) == (NEVER,) * 5


def test_a_median_of_seeds_most_of_which_never_got_there_is_never() -> None:
    assert spread([100.0, 300.0, 200.0]) == "200 (100, 300)"
    assert spread([NEVER, 250.0, NEVER]) == "never (250, never)"
    assert spread([1234.5], 1) == "1,234.5"


def test_the_goal_is_told_by_the_best_peers_median_and_by_how_much_it_is_missed() -> None:
    made = groups(RESULTS)
    sentence = goal(made, "registered")
    assert "best peer is Tianshou with 300 s; apex_bat took 100 s, 0.33 of that" in sentence
    assert sentence.endswith("at most 1/3: met.")
    slower = groups([*at("apex_bat", "registered", 200.0), *at("tianshou", "registered", 300.0)])
    assert goal(slower, "registered").endswith("missed by a factor of 2.0.")


def test_where_no_peer_got_there_the_budget_bounds_the_ratio() -> None:
    sentence = goal(groups(RESULTS), "obvious")
    assert "no peer reached 14 of 15 in 600 s in the median" in sentence
    assert "less than 0.17 of their time; the goal is at most 1/15: not decided by this budget" in sentence
    quick = groups([*at("apex_bat", "registered", 30.0), *at("sb3", "obvious", NEVER)])
    assert goal(quick, "obvious").endswith("met.")


def test_without_apex_bat_nothing_is_compared_and_without_success_it_has_missed() -> None:
    assert "nothing can be compared" in goal(groups(at("sb3", "registered", 50.0)), "registered")
    failed = groups([*at("apex_bat", "registered", NEVER), *at("sb3", "registered", 50.0)])
    assert "apex_bat never reached 14 of 15" in goal(failed, "registered")


def test_the_table_has_a_line_for_each_entry_and_apex_bat_in_both() -> None:
    lines = table(groups(RESULTS), "obvious")[2:]
    assert [line.split(" | ")[0] for line in lines] == ["| apex_bat (registered environment)", "| Tianshou"]
    times = ("never (500, never)", "never (50,000, never)", "never (5,000, never)", "never (1,000, never)")
    assert f"| {' | '.join(times)} | never (150, never) |" in lines[1]
    assert "| 5 (5, 12) |" in lines[1]


def test_the_page_tells_rules_versions_trials_and_the_command() -> None:
    trial = at("sb3", "registered", 80.0)[0] | {"overrides": ["adam=1"], "budget_s": 120.0}
    page = document({"machine": MACHINE, "terms": TERMS, "results": RESULTS}, [trial])
    for text in (
        "torch 2.13.0", "`adam=1`", "commit abc", "--budget-s 600 --seeds 3 --every-s 10", "14 of 15", "every 10 s",
        "one update for 8 steps", "every 77 updates", "RMSprop with 0.003",
    ):  # fmt: skip
        assert text in " ".join(page.split())
    assert "No trials are kept." in document({"machine": MACHINE, "terms": TERMS, "results": RESULTS}, [])
    other = [each | {"budget_s": 900.0} if each["environment"] == "obvious" else each for each in RESULTS]
    assert "--obvious-budget-s 900" in document({"machine": MACHINE, "terms": TERMS, "results": other}, [])


def test_page_and_picture_are_written_beside_the_results(tmp_path: Path) -> None:
    file = tmp_path / "peers.json"
    file.write_text(json.dumps({"machine": MACHINE, "terms": TERMS, "results": RESULTS}))
    (tmp_path / "peers_trials.json").write_text(json.dumps({"results": at("sb3", "registered", 80.0)}))
    page = report.write(file)
    assert page == tmp_path / "peers.md"
    assert "as chosen" in page.read_text()
    assert (tmp_path / "peers.png").read_bytes().startswith(b"\x89PNG")


def test_a_curve_begins_with_no_flight_completed_and_changes_evenly_between_judgements() -> None:
    made = result("sb3", "registered", 0, [(10.0, 0), (20.0, 10), (25.0, None), (40.0, 14)])
    np.testing.assert_allclose(on_grid(made, np.array([0.0, 5.0, 15.0, 30.0, 50.0])), [0, 0, 5, 12, 14])


def test_a_picture_of_one_environment_has_one_panel(tmp_path: Path) -> None:
    draw(groups(at("sb3", "registered", 80.0)), tmp_path / "one.png")
    draw(groups(RESULTS), tmp_path / "both.png")
    assert (tmp_path / "one.png").stat().st_size < (tmp_path / "both.png").stat().st_size


@pytest.mark.skipif(not FILE.exists(), reason="the contest was not held yet")
def test_the_committed_page_is_made_from_the_committed_results() -> None:
    content = json.loads(FILE.read_text(encoding="utf-8"))
    assert FILE.with_suffix(".md").read_text(encoding="utf-8") == document(content, load_trials(FILE))
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert summary(content["results"]) in readme
