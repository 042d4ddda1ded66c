"""The page of settings."""

from pathlib import Path

import msgspec

from apex_bat.config import settings
from apex_bat.config.page import document, meanings
from apex_bat.config.sections import Section

PAGE = Path(__file__).parents[2] / "docs" / "settings.md"


def test_the_page_in_the_docs_is_the_one_made_from_the_classes() -> None:
    assert PAGE.read_text(encoding="utf-8") == document()


def test_every_setting_is_explained() -> None:
    kinds = [getattr(settings, name) for name in settings.__all__ if name != "Condition"]
    for kind in kinds:
        fields = {field.name for field in msgspec.structs.fields(kind) if not isinstance(field.default, Section)}
        assert fields <= meanings(kind).keys(), kind.__name__
