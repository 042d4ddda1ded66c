"""Ablations: each loads, asks a question in its first line, and differs from the default in what it is about."""

from pathlib import Path

import pytest

from apex_bat.cli.checking import check
from apex_bat.config import Config, load
from apex_bat.config.loading import differences

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "ablations"
FILES = sorted(FOLDER.glob("*.toml"))
PAGE = FOLDER.parents[1] / "docs" / "reproduction.md"
REFERENCES = {"memory_3", "rendering_thesis", "onset_zero"}
"""Those that are the default, written out for their series."""
DOUBLE = {"echo_noise", "motion_noise"}
"""Those that change two settings of their subject."""


def test_there_are_ablations() -> None:
    assert {"memory_1", "memory_2", "memory_3", "memory_5"} <= {path.stem for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_ablation_is_valid_and_changes_only_its_subject(path: Path) -> None:
    question = path.read_text().splitlines()[0]
    assert question.startswith("# ")
    assert "?" in question
    config = load(path)
    check(config)
    beside = {"train.max_minutes", "condition", "evaluation.arenas"}
    changed = {line.partition(":")[0] for line in differences(Config(), config)} - beside
    assert len(changed) == (0 if path.stem in REFERENCES else 2 if path.stem in DOUBLE else 1), changed
    assert len({key.partition(".")[0] for key in changed}) <= 1


def test_the_page_says_which_change_nothing_or_two_settings() -> None:
    text = " ".join(PAGE.read_text().partition("## Ablations")[2].split())
    assert "`memory_3`, `rendering_thesis` and `onset_zero` change nothing" in text
    assert "`echo_noise` and `motion_noise` change two each" in text
