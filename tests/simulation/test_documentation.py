"""docs/simulation.md says what is so: its examples run, and its numbers are those of the settings and the benchmark."""

import doctest
import json
import re
from pathlib import Path

import msgspec
import pytest

from apex_bat.config.sections import Section
from apex_bat.config.settings import Body, Episode, Rays, Sensing, Sonar

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = DOCS / "simulation.md"
SECTIONS: dict[str, type[Section]] = {
    "body": Body,
    "rays": Rays,
    "sonar": Sonar,
    "sensing": Sensing,
    "episode": Episode,
}


def rows_of(first_column: int) -> dict[str, list[str]]:
    """Returns the rows of all tables that have a name in backticks in some column, by that name."""
    rows = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and len(cells) > first_column and re.fullmatch(r"`[a-z_.0-9]+`", cells[first_column]):
            rows[cells[first_column].strip("`")] = cells
    return rows


def test_examples_run() -> None:
    failed, attempted = doctest.testfile(str(PAGE), module_relative=False, encoding="utf-8")
    assert attempted > 15
    assert failed == 0


def test_table_of_settings_is_complete_and_has_their_defaults() -> None:
    told = {name: cells[1] for name, cells in rows_of(0).items() if name.split(".")[0] in SECTIONS and "." in name}
    fields = {
        f"{name}.{field.name}": field.default
        for name, section in SECTIONS.items()
        for field in msgspec.structs.fields(section)
    }
    assert told.keys() == fields.keys()
    words = {"none": None, "true": True, '""': ""}
    for name, default in fields.items():
        expected = float(told[name]) if isinstance(default, float) else words.get(told[name], told[name])
        assert expected == default or told[name] == str(default), name


def test_figures_are_those_of_the_benchmark() -> None:
    records = json.loads((DOCS / "results" / "bench_simulation.json").read_text(encoding="utf-8"))
    told = {name: cells for name, cells in rows_of(1).items() if name.startswith("simulation.")}
    assert told.keys() == {record["name"] for record in records}
    for record in records:
        _, _, median, limits, unit = told[record["name"]]
        assert float(median) == pytest.approx(record["median"], rel=1e-3)
        assert [float(limit) for limit in limits.split(" to ")] == pytest.approx(
            [record["min"], record["max"]], rel=1e-3
        )
        assert unit == record["unit"]


def test_the_goal_of_twenty_times_the_obvious_way_is_reached() -> None:
    assert float(rows_of(1)["simulation.ratio"][2]) >= 20.0


@pytest.mark.parametrize("name", re.findall(r"\]\((results/\S+\.png)\)", PAGE.read_text(encoding="utf-8")))
def test_pictures_are_there_and_small(name: str) -> None:
    assert 10_000 < (DOCS / name).stat().st_size < 200_000
