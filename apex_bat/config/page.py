"""The page of all settings, `docs/settings.md`, made from their classes.

Run `python -m apex_bat.config.page > docs/settings.md` after a change; a test holds the page to the classes.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from itertools import pairwise
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from apex_bat.config.sections import Section
from apex_bat.config.settings import Config


def document() -> str:
    """Returns the page, Markdown: a table for each section, with default, range and meaning of each setting."""
    lines = [
        "# Settings",
        "",
        "Made by `python -m apex_bat.config.page`. A file of settings is TOML with these sections; on the command line",
        'each is `--set section.key=value`, and `none` stands for no value. "Thesis" is Mohan & Vanderelst (2020),',
        '"Ape-X" is Horgan et al. (2018).',
        "",
        *_table(Config, "## Of the whole run"),
    ]
    for name, kind in _sections().items():
        lines += ["", *_table(kind, f"## [{name}]", inspect.getdoc(kind) or "")]
    return "\n".join(lines) + "\n"


def meanings(kind: type[Section]) -> dict[str, str]:
    """Returns the text under each field of a section, in one line."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    texts = {}
    for field, below in pairwise(tree.body if isinstance(tree, ast.ClassDef) else ()):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                texts[name] = " ".join(text.split())
    return texts


def _sections() -> dict[str, type[Section]]:
    hints = get_type_hints(Config)
    fields = msgspec.structs.fields(Config)
    return {field.name: hints[field.name] for field in fields if isinstance(field.default, Section)}


def _table(kind: type[Section], title: str, text: str = "") -> list[str]:
    texts, hints = meanings(kind), get_type_hints(kind, include_extras=True)
    rows = [
        f"| `{field.name}` | {_written(field.default)} | {_range(hints[field.name])} | {texts[field.name]} |"
        for field in msgspec.structs.fields(kind)
        if not isinstance(field.default, Section)
    ]
    head = [title, "", text, ""] if text else [title, ""]
    return [*head, "| name | default | allowed | |", "|---|---|---|---|", *rows]


def _written(value: Any) -> str:
    """Returns a default as one would write it in a file."""
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return f"`[{', '.join(_written(each).strip('`') for each in value)}]`"
    return f"`{str(value).lower()}`" if isinstance(value, bool) else f"`{value!r}`".replace("'", '"')


def _range(hint: Any) -> str:
    """Returns what the type of a setting allows, in words."""
    options = [option for option in get_args(hint) if option is not type(None)]
    if get_origin(hint) is Annotated:
        base, *notes = get_args(hint)
        bounds = [bound for note in notes if isinstance(note, Meta) for bound in _bounds(note)]
        return " and ".join(bounds) or _range(base)
    if get_origin(hint) is tuple:
        return f"list; each {_range(options[0])}"
    if options and all(isinstance(option, str) for option in options):
        return ", ".join(f"`{option}`" for option in options)
    if options:
        return " or ".join(_range(option) for option in options) + ", or none"
    return {"str": "text", "float": "any number", "int": "any whole number", "bool": "`true`, `false`"}[hint.__name__]


def _bounds(note: Meta) -> list[str]:
    signs = (("gt", "above"), ("ge", "at least"), ("lt", "below"), ("le", "at most"))
    return [f"{word} {getattr(note, sign):g}" for sign, word in signs if getattr(note, sign) is not None]


if __name__ == "__main__":
    print(document(), end="")  # noqa: T201  # a page to redirect into a file
