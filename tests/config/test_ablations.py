"""Ablations: each loads, asks a question in its first line, and differs from the default in what it is about."""

from pathlib import Path

import pytest

from apex_bat.cli.training import check
from apex_bat.config import Config, load
from apex_bat.config.loading import differences

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "ablations"
FILES = sorted(FOLDER.glob("*.toml"))
REFERENCES = {"memory_3", "rendering_thesis"}
"""Those that are the default, written out for their series."""


def test_there_are_ablations() -> None:
    assert {"memory_1", "memory_2", "memory_3", "memory_5"} <= {path.stem for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_an_ablation_is_valid_and_changes_only_its_subject(path: Path) -> None:
    question = path.read_text().splitlines()[0]
    assert question.startswith("# ")
    assert "?" in question
    config = load(path)
    check(config)
    changed = {line.partition(":")[0] for line in differences(Config(), config)} - {"train.max_minutes", "condition"}
    subjects = {key.partition(".")[0] for key in changed if key != "onset"} - {"evaluation"}
    onset_zero = path.stem == "onset_zero"
    assert len(subjects) == (0 if path.stem in REFERENCES or onset_zero else 1), changed
