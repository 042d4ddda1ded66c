"""The page of measured figures."""

from pathlib import Path

import pytest

from benchmarks.performance import TARGETS, Target, document, records, summary_line, verdict

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "performance.md"


def test_the_page_is_the_one_made_from_the_committed_results() -> None:
    assert PAGE.read_text(encoding="utf-8") == document(records())


def test_every_target_is_measured() -> None:
    assert {target.name for target in TARGETS} <= records().keys()


def test_the_readme_says_which_targets_are_missed() -> None:
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert summary_line(records()) in readme


@pytest.mark.parametrize(
    ("limit", "is_least", "measured", "says"),
    [
        (20.0, True, 27.0, "met"),
        (20.0, True, 15.0, "missed by 25%"),
        (2.0, False, 2.0, "met"),
        (2.0, False, 3.0, "missed by 50%"),
    ],
)
def test_a_verdict_says_by_how_much_a_target_is_missed(
    limit: float, is_least: bool, measured: float, says: str
) -> None:
    assert verdict(Target("it", "name", limit, is_least), measured) == says
