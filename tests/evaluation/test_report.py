"""The report: the answer first, every figure loaded, nothing made up."""

import base64
import dataclasses
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from apex_bat.config import load
from apex_bat.evaluation import document, figures
from apex_bat.evaluation.groups import group
from apex_bat.evaluation.plates import CAPTIONS
from apex_bat.evaluation.report import write_report
from apex_bat.evaluation.results import Judged, Protocol
from tests.evaluation.conftest import MakeJudged, judged

PROTOCOL = Protocol()


def baselines(make_judged: MakeJudged) -> list[Judged]:
    """Two baselines; their names are what counts."""
    flown = []
    for name, number in (("random", 0), ("oracle", 15)):
        each = make_judged("memory", completed=(number,) * 3)
        flown.append(Judged(name, name, each.config, each.records, each.traces))
    return flown


@pytest.fixture(scope="module")
def one_seed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on one run of one condition, with all figures."""
    folder = tmp_path_factory.mktemp("report")
    write_report([judged("memory", completed=(14, 10, 13))], baselines(judged), PROTOCOL, folder)
    return folder


def no_figures(*_: object) -> list[document.Picture]:
    """Draws nothing, which takes no time."""
    return []


def test_a_report_on_one_seed_gives_no_intervals_and_no_verdicts(one_seed: Path) -> None:
    text = (one_seed / "report.md").read_text()
    answer = text.split("\n\n")[1]
    assert answer.startswith("**These runs do not tell whether the thesis is reproduced: none of its 17 numbers")
    assert "Seeds: memory 1." in answer
    assert "memory 82 %; random 0 %; oracle 100 %" in answer
    assert "[" not in answer
    assert "| reproduced |" not in text
    assert "| not reproduced |" not in text
    assert "is inferred" in text
    assert "| memory-0 | memory | 0 | 180,000 | 22,000 | - | 3 |" in text
    assert "| memory | 1 | 82 | - | 1" in text, "no interquartile mean of three values"
    assert "chosen that flew best in the training arena among the 3 that were judged" in text
    assert "14 of the 15 starts" in text
    assert "corrected for" not in text
    assert "nan" not in text


def test_the_page_holds_every_figure_and_fetches_nothing(one_seed: Path) -> None:
    page = (one_seed / "index.html").read_text()
    pictures = re.findall(r'<img alt="[^"]+" src="data:image/png;base64,([^"]+)"', page)
    assert len(pictures) == len(CAPTIONS)
    assert all(base64.b64decode(picture).startswith(b"\x89PNG") for picture in pictures)
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    for name in CAPTIONS:
        assert (one_seed / "figures" / f"{name}.svg").read_text().lstrip().startswith("<?xml")


def test_three_seeds_give_verdicts_intervals_and_corrected_tests(make_judged: MakeJudged, tmp_path: Path) -> None:
    outcomes = {"memory": (15, 15, 15), "no_memory": (10, 10, 10), "onset": (3, 3, 3)}
    runs = [make_judged(name, seed, completed=number) for name, number in outcomes.items() for seed in range(3)]
    write_report(runs, baselines(make_judged), PROTOCOL, tmp_path, no_figures)
    text = (tmp_path / "report.md").read_text()
    answer = text.split("\n\n")[1]
    assert re.match(r"\*\*Of 17 numbers of the thesis \d+ are reproduced, \d+ are not, and \d+ cannot", answer)
    assert "Reproduced: flights completed, memory;" in answer
    assert "memory less no_memory: 33 points [" in answer
    # the least p of three seeds against three is 0.1; Holm over 6 tests makes 0.6 of it
    assert "p = 0.6 (Holm; one test alone can reach 0.1 at best)" in answer
    assert "\u2020" not in answer
    assert "memory 100 % [97, 100]\u2021;" in answer
    assert "\u2021 No resample differs: a share whose flights all ended alike has Wilson's interval" in answer
    assert "99, 94 and 86 % (of 3 seeds), 99, 96 and 91 % (of 5 seeds) of the time" in text
    assert text.count("alike long |") == 6


def test_unequal_training_is_told_wherever_conditions_are_compared(make_judged: MakeJudged, tmp_path: Path) -> None:
    runs = [make_judged("memory", seed, env_steps=360_000) for seed in range(3)]
    runs += [make_judged("onset", seed, completed=(3, 3, 3)) for seed in range(3)]
    write_report(runs, [], PROTOCOL, tmp_path, no_figures)
    text = (tmp_path / "report.md").read_text()
    assert "at best) (trained for 180,000 to 360,000 steps)." in text.split("\n\n")[1]
    assert text.count("| trained for 180,000 to 360,000 steps |\n") == 2


def test_the_method_speaks_of_all_runs(make_judged: MakeJudged, tmp_path: Path) -> None:
    other = load(None, ["arena=circle", "sonar.rendering=exact", "episode.evaluation_steps=500"])
    unjudged = make_judged("memory", 1, config=other)
    runs = [make_judged("memory"), dataclasses.replace(unjudged, curve=None)]
    write_report(runs, baselines(make_judged), PROTOCOL, tmp_path, no_figures)
    text = (tmp_path / "report.md").read_text()
    assert "trained in circle or simple." in text
    assert "until 1000 or 500 steps" in text
    assert "rendered by exact or thesis." in text
    assert "Of 1 of 2 runs no checkpoint was judged: the newest was taken." in text
    assert "They flew with body, rays, ear and time limit of the first run given. memory (arena circle, " in text
    write_report([runs[1]], [], PROTOCOL, tmp_path, no_figures)
    assert "flew best" not in (tmp_path / "report.md").read_text()


def test_comparisons_of_settings_that_all_runs_share_are_in_the_answer(make_judged: MakeJudged, tmp_path: Path) -> None:
    thesis = load(Path(__file__).resolve().parents[2] / "configs" / "thesis.toml")
    runs = [make_judged(name, seed, config=thesis) for name in ("memory", "onset") for seed in range(2)]
    write_report(runs, [], PROTOCOL, tmp_path, no_figures)
    text = (tmp_path / "report.md").read_text()
    assert re.search(r"memory \(\d+ other settings, \w+\) less onset", text.split("\n\n")[1])
    assert re.search(
        r"memory \(\d+ other settings, \w+\) differs from the default in actors 1, bats_per_actor 1, ", text
    )


def test_no_correction_is_claimed_where_there_are_no_tests(make_judged: MakeJudged, tmp_path: Path) -> None:
    write_report([make_judged("memory"), make_judged("onset")], [], PROTOCOL, tmp_path, no_figures)
    assert "No tests: they need two seeds of both." in (tmp_path / "report.md").read_text()


def test_two_seeds_are_marked(make_judged: MakeJudged, tmp_path: Path) -> None:
    runs = [make_judged("memory", seed, completed=(15, 15, 10 + seed)) for seed in range(2)]
    write_report(runs, [], PROTOCOL, tmp_path, no_figures)
    answer = (tmp_path / "report.md").read_text().split("\n\n")[1]
    assert "]\u2020" in answer
    assert "An interval from fewer than 3 seeds." in answer


def test_a_band_is_drawn_from_three_seeds_on() -> None:
    rows = [(np.array([0.0, 10.0]), np.array([0.0, 1.0 + seed])) for seed in range(3)]
    grid, mean, band = figures.mean_curve(rows)
    assert band is not None
    assert (grid[0], grid[-1]) == (0.0, 10.0)
    assert mean[-1] == pytest.approx(2.0)
    assert band[0, -1] >= 1.0
    assert band[1, -1] <= 3.0
    assert figures.mean_curve(rows[:2])[2] is None


def test_curves_are_compared_where_every_seed_has_them() -> None:
    rows = [(np.array([0.0, 10.0]), np.array([0.0, 10.0])), (np.array([2.0, 8.0]), np.array([2.0, 8.0]))]
    grid, mean, _ = figures.mean_curve(rows)
    assert (grid[0], grid[-1]) == (2.0, 8.0)
    np.testing.assert_allclose(mean, grid)


def test_trajectories_mark_collisions_alone(make_judged: MakeJudged) -> None:
    groups = group([make_judged("memory", completed=(14, 15, 0))])
    axes = figures.trajectories(groups, PROTOCOL.arenas).axes
    stars = [len(line.get_xdata()) for each in axes for line in each.lines if line.get_marker() == "*"]  # type: ignore[arg-type]
    assert stars == [1, 0, 15]
    assert [each.get_title(loc="left") for each in axes] == [
        "memory, simple: 14 of 15", "memory, narrow: 15 of 15", "memory, circle: 0 of 15",
    ]  # fmt: skip


def test_words_of_a_table_cannot_break_it() -> None:
    table = document.Table(("a", "b"), [("x | y", "<b>\n&")])
    assert document.to_markdown([table], "figures").splitlines()[-1] == "| x \\| y | <b> & |"
    page = document.to_html([table, document.Bullets(["<script>"])], "t & u", Path())
    assert "&lt;b&gt;" in page
    assert "<li>&lt;script&gt;</li>" in page
    assert "<title>t &amp; u</title>" in page


@pytest.mark.slow
def test_a_browser_loads_every_figure(one_seed: Path, tmp_path: Path) -> None:
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("there is no Chromium to open the page with")
    # A script tells what the browser made of each picture; it is not part of the report.
    page = tmp_path / "opened.html"
    script = (
        "<script>onload = () => document.body.setAttribute('data-widths',"
        " [...document.images].map(each => each.complete ? each.naturalWidth : 0).join(' '))</script>"
    )
    page.write_text((one_seed / "index.html").read_text().replace("</body>", f"{script}</body>"))
    profile = tmp_path / "profile"
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}", "--dump-dom"]
    output = subprocess.run(
        [*command, "--virtual-time-budget=20000", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stdout
    found = re.search(r'data-widths="([^"]*)"', output)
    assert found is not None
    widths = [int(width) for width in found[1].split()]
    assert len(widths) == len(CAPTIONS)
    assert min(widths) > 300
