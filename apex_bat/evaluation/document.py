"""A document of headings, paragraphs, tables and figures, as Markdown and as one HTML page without attachments."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class Heading(NamedTuple):
    """A title of a part."""

    text: str
    level: int = 2


class Paragraph(NamedTuple):
    """Running text; `is_answer` marks the one that is read first."""

    text: str
    is_answer: bool = False


class Bullets(NamedTuple):
    """A list."""

    items: Sequence[str]


class Table(NamedTuple):
    """Rows of text; the first `num_left` columns are words, the others numbers."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    num_left: int = 1


class Picture(NamedTuple):
    """A figure: the name of its PNG in the folder of figures; the SVG lies beside it."""

    name: str
    caption: str


Block = Heading | Paragraph | Bullets | Table | Picture

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 2rem auto; max-width: 62rem;
  padding: 0 1rem; }
h1 { font-size: 1.7rem; line-height: 1.25; } h2 { font-size: 1.25rem; margin-top: 2.2rem; }
h3 { font-size: 1.05rem; margin-top: 1.6rem; }
.answer { font-size: 1.08rem; border-left: 4px solid #0072b2; padding: .2rem 0 .2rem 1rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; margin: .6rem 0; }
caption { caption-side: top; text-align: left; color: #444; padding-bottom: .3rem; }
th, td { padding: .22rem .7rem .22rem 0; text-align: right; vertical-align: top; border-bottom: 1px solid #ddd; }
th { border-bottom: 2px solid #555; } td { white-space: nowrap; } td.left, td:last-child { white-space: normal; }
td.left:last-child { min-width: 14rem; }
.left { text-align: left; }
figure { margin: 1.4rem 0; } img { max-width: 100%; height: auto; } figcaption { color: #444; font-size: .9rem; }
@media print { body { max-width: none; margin: 0; } figure, tr { break-inside: avoid; } }
</style>
</head>
<body>
{% for kind, block in blocks -%}
{% if kind == "Heading" %}<h{{ block.level }}>{{ block.text }}</h{{ block.level }}>
{% elif kind == "Paragraph" %}<p{% if block.is_answer %} class="answer"{% endif %}>{{ block.text }}</p>
{% elif kind == "Bullets" %}<ul>{% for item in block["items"] %}<li>{{ item }}</li>{% endfor %}</ul>
{% elif kind == "Table" %}<div class="wide"><table>
{% if block.caption %}<caption>{{ block.caption }}</caption>{% endif %}
<thead><tr>{% for cell in block.columns %}<th{% if loop.index0 < block.num_left %} class="left"{% endif %}>
{{- cell }}</th>{% endfor %}</tr></thead>
<tbody>
{% for row in block.rows %}<tr>{% for cell in row %}<td{% if loop.index0 < block.num_left %} class="left"{% endif %}>
{{- cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% elif kind == "Picture" %}<figure><img alt="{{ block.caption }}" src="{{ pictures[block.name] }}">
<figcaption>{{ block.caption }}</figcaption></figure>
{% endif %}
{%- endfor %}
</body>
</html>
"""


def to_markdown(blocks: Sequence[Block], figures: str) -> str:
    """Returns the document as Markdown; `figures` is the folder of pictures as seen from the file."""
    return "\n\n".join(_markdown(block, figures) for block in blocks) + "\n"


def to_html(blocks: Sequence[Block], title: str, folder: Path) -> str:
    """Returns the document as one page that holds its pictures, taken from `folder`. Needs Jinja2."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    names = [block.name for block in blocks if isinstance(block, Picture)]
    pictures = {name: _data_address((folder / name).read_bytes()) for name in names}
    kinds = [(type(block).__name__, block._asdict()) for block in blocks]
    return environment.from_string(_PAGE).render(title=title, blocks=kinds, pictures=pictures)


def _data_address(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _markdown(block: Block, figures: str) -> str:
    if isinstance(block, Heading):
        return f"{'#' * block.level} {block.text}"
    if isinstance(block, Paragraph):
        return f"**{block.text}**" if block.is_answer else block.text
    if isinstance(block, Bullets):
        return "\n".join(f"- {item}" for item in block.items)
    if isinstance(block, Picture):
        svg = Path(block.name).with_suffix(".svg")
        return f"![{block.caption}]({figures}/{block.name})\n\n*{block.caption}* ([SVG]({figures}/{svg}))"
    rules = ["---" if number < block.num_left else "--:" for number in range(len(block.columns))]
    lines = [_row(block.columns), _row(rules), *(_row(row) for row in block.rows)]
    return "\n".join([block.caption, "", *lines] if block.caption else lines)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
