"""The README's figures are those of the committed results."""

import json
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
REPORT = (ROOT / "docs" / "results" / "reproduction" / "report.md").read_text(encoding="utf-8")
RESULT: dict[str, Any] = json.loads((ROOT / "docs" / "results" / "memory_simple.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("row", RESULT["summary"], ids=lambda row: row["arena"])
def test_each_row_of_the_table_is_that_of_the_result(row: dict[str, Any]) -> None:
    line = (
        f"| {row['arena']} | {row['completed']} of {row['flights']} | {row['steps_mean']:.0f} "
        f"| {row['distance_m_mean']:.1f} | {row['progress_m_mean']:.1f} | {100 * row['straight_share_mean']:.0f} |"
    )
    assert line in README


def test_the_bat_of_the_readme_completes_all_flights_in_the_arenas_of_the_thesis() -> None:
    completed = {row["arena"]: (row["completed"], row["flights"]) for row in RESULT["summary"]}
    assert completed == {"simple": (15, 15), "narrow": (15, 15), "circle": (15, 15)}


@pytest.mark.parametrize("pilot", ["memory", "no_memory", "onset", "random", "ild", "oracle"])
def test_each_row_of_the_thesis_repeated_is_that_of_the_report(pilot: str) -> None:
    def cells(text: str) -> list[str]:
        row = next(line for line in text.splitlines() if line.startswith(f"| {pilot} | "))
        return row.strip("| ").split(" | ")

    seeds, completed, distance_m, progress_m = (cells(REPORT)[column] for column in (1, 2, 4, 6))
    assert cells(README)[1:5] == [seeds, completed, distance_m, progress_m]


def test_how_many_numbers_of_the_thesis_are_reproduced_is_what_the_report_says() -> None:
    sentence = REPORT.partition("**")[2].partition(". ")[0]
    assert sentence.startswith("Of 17 numbers of the thesis")
    assert sentence in " ".join(README.split())


def test_what_other_starts_gave_is_said() -> None:
    other = json.loads((ROOT / "docs" / "results" / "memory_other_starts.json").read_text(encoding="utf-8"))
    completed = {row["arena"]: row["completed"] for row in other["summary"]}
    assert other["learner_step"] == RESULT["learner_step"]
    sentence = f"{completed['simple']} in simple, {completed['narrow']} in narrow and {completed['circle']} in circle"
    assert sentence in " ".join(README.split())


def test_seed_time_and_size_of_the_training_are_those_of_the_result() -> None:
    training = RESULT["training"]
    minutes, seconds = divmod(round(training["wall_s"]), 60)
    text = " ".join(README.split())
    assert f"seed {training['seed']}, {minutes} min {seconds} s" in text
    assert f"{training['env_steps']:,} steps and {training['learner_steps']:,} updates" in text


def test_pictures_of_the_readme_exist() -> None:
    names = [part.partition(")")[0] for part in README.split("](")[1:] if part.partition(")")[0].endswith(".png")]
    assert names
    assert all((ROOT / name).is_file() for name in names)


def test_rates_of_the_simulation_are_those_of_the_committed_benchmark() -> None:
    records = json.loads((ROOT / "docs" / "results" / "bench_simulation.json").read_text(encoding="utf-8"))
    median = {record["name"]: record["median"] for record in records}
    for way in ("obvious", "single", "sixteen"):
        assert f"| {median[f'simulation.{way}.steps_per_s']:.0f} |" in README
    text = " ".join(README.split())
    assert f"{median['simulation.ratio']:.0f} times the obvious way" in text
    stages = {name: median[f"simulation.stage.{name}_us"] for name in ("ear", "rays", "world", "starts", "rest")}
    assert (
        f"the ear takes {stages['ear']:.0f}, rays {stages['rays']:.0f}, motion and contact {stages['world']:.0f}, "
        f"new starts {stages['starts']:.0f} and the rest {stages['rest']:.0f}"
    ) in text
