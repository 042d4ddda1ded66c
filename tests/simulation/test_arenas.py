"""Arenas by name, and what is said about bad ones."""

from pathlib import Path

import numpy as np
import pytest

from apex_bat.config.settings import Body
from apex_bat.simulation.arenas import ArenaError, arena_folder, load_arena, load_arenas
from apex_bat.simulation.ground import ground_plan
from apex_bat.simulation.layout import Arena
from apex_bat.simulation.progress import centre_lines

ROOM = """
start = [0.0, 0.0]
walls = [
    [0.0, 2.0, 0.0, 4.0, 0.1, 1.0],
    [0.0, -2.0, 0.0, 4.0, 0.1, 1.0],
    [2.0, 0.0, 1.5708, 4.0, 0.1, 1.0],
    [-2.0, 0.0, 1.5708, 4.0, 0.1, 1.0],
]
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "room.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("name", "num_walls", "num_pillars"),
    [("simple", 12, 0), ("narrow", 12, 0), ("circle", 8, 1), ("circuit", 9, 0), ("maze", 12, 4)],
)
def test_shipped_arena_loads_with_all_its_walls_and_says_where_it_comes_from(
    name: str, num_walls: int, num_pillars: int
) -> None:
    arena = load_arena(name)
    assert (arena.name, len(arena.walls), len(arena.pillars)) == (name, num_walls, num_pillars)
    assert "gym-gazebo" in arena.about
    assert {wall.height_m for wall in arena.walls} == {1.0}
    assert {wall.thickness_m for wall in arena.walls} == {0.15}


def test_every_shipped_file_loads() -> None:
    names = sorted(path.stem for path in arena_folder().glob("*.toml"))
    assert [arena.name for arena in load_arenas(",".join(names))] == names


@pytest.mark.parametrize(
    ("name", "least_m", "lap_m"), [("simple", 0.68, 30.4), ("narrow", 0.57, 25.9), ("circle", 0.56, 12.7)]
)
def test_centre_line_runs_in_the_middle_of_the_corridor(name: str, least_m: float, lap_m: float) -> None:
    arena = load_arena(name)
    line = np.array(arena.centre_line)
    points = np.concatenate([line + share * (np.roll(line, -1, axis=0) - line) for share in np.linspace(0, 1, 50)])
    assert ground_plan([arena]).clearance_m(points, np.zeros(len(points), np.int64)).min() > least_m
    assert centre_lines([arena]).length_m[0] == pytest.approx(lap_m, abs=0.1)


def test_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(ArenaError, match=r"nowhere: no such arena; there are circle, circuit, maze, narrow, simple"):
        load_arena("nowhere")


def test_path_to_a_file_is_an_arena_named_after_it(tmp_path: Path) -> None:
    arena = load_arena(write(tmp_path, ROOM))
    assert arena.name == "room"
    assert arena == load_arena(str(tmp_path / "room.toml"))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("start = [0.0", "room.toml: not valid TOML"),
        ("walls = []", "room.toml: malformed arena: .*`start`"),
        (ROOM.replace("4.0, 0.1", '"long", 0.1', 1), r"room.toml: malformed arena: .*`\$.walls\[0\]\[3\]`"),
        (ROOM.replace("4.0, 0.1", "-4.0, 0.1", 1), "wall 0: length_m is -4.0; it must be greater than 0"),
        (ROOM.replace("2.0, 0.0, 4.0", "nan, 0.0, 4.0", 1), "wall 0: y_m is nan; it must be a finite number"),
        (ROOM + "wals = []", "room.toml: malformed arena: .*`wals`"),
        ("start = [0.0, 0.0]", "there are neither walls nor pillars nor models"),
        (ROOM + "centre_line = [[0.0, 0.0], [1.0, 1.0]]", "needs at least 3"),
    ],
)
def test_malformed_file_is_refused_by_name_and_place(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(ArenaError, match=complaint):
        load_arena(write(tmp_path, text))


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ArenaError, match=r"gone\.toml: no such arena file"):
        load_arena(tmp_path / "gone.toml")


def test_walls_that_leave_no_safe_start_are_refused(tmp_path: Path) -> None:
    cell = ROOM.replace("2.0", "0.42")
    with pytest.raises(ArenaError, match="room: its walls leave no safe start"):
        load_arena(write(tmp_path, cell))


def test_start_inside_a_wall_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArenaError, match=r"its start \(2.0, 0.0\) lies in a wall"):
        load_arena(write(tmp_path, ROOM.replace("start = [0.0", "start = [2.0")))


def test_a_robot_too_wide_for_the_arena_is_told_so() -> None:
    load_arena("narrow")
    with pytest.raises(ArenaError, match="narrow: its walls leave no safe start"):
        load_arena("narrow", body=Body(diameter_m=1.3))


def test_one_arena_is_wanted_where_several_are_named() -> None:
    assert [arena.name for arena in load_arenas("simple,corridor:3-5")] == [
        "simple",
        *(f"corridor:{k}" for k in (3, 4, 5)),
    ]
    with pytest.raises(ArenaError, match="these are 2 arenas, and one is wanted"):
        load_arena("simple,circle")


@pytest.mark.parametrize("name", ["corridor:x", "corridor:", "forest:3-", "forest:5-2"])
def test_bad_seed_of_a_family_is_refused(name: str) -> None:
    with pytest.raises(ArenaError, match=f"{name}: "):
        load_arena(name)


def test_arena_is_immutable_and_hashable() -> None:
    arena: Arena = load_arena("simple")
    assert hash(arena) == hash(load_arena("simple"))
    with pytest.raises(AttributeError):
        arena.name = "other"  # type: ignore[misc]
