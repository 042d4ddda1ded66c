"""Declared metrics, and the page made from them."""

from pathlib import Path

from apex_bat.roles.metrics import DECLARED, document

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_in_the_docs_is_the_one_made_from_the_declarations() -> None:
    assert (DOCS / "metrics.md").read_text(encoding="utf-8") == document()


def test_every_figure_has_a_unit_and_a_meaning() -> None:
    assert all(metric.unit and metric.meaning for metrics in DECLARED.values() for metric in metrics.values())
