"""How the figures of a report look: one palette for people of all eyesight, marks that differ in grey, two formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from apex_bat.recording.series import ACTION_COLOURS, BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Rgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PNG_DPI = 130
SMALL, NORMAL = 8.0, 9.5  # points
WALL_SHADE = "0.35"


class Look(NamedTuple):
    """How a condition is drawn wherever it appears."""

    colour: str
    dashes: str | tuple[float, tuple[float, ...]]
    hatch: str


def _hex(colour: Rgb) -> str:
    return "#" + "".join(f"{channel:02x}" for channel in colour)


LOOKS = {
    "memory": Look("#0072b2", "-", ""),
    "no_memory": Look(_hex(ORANGE), "--", "//"),
    "onset": Look(_hex(GREEN), "-.", ".."),
    "random": Look("0.82", ":", ""),
    "straight": Look("0.68", ":", ""),
    "ild": Look("0.54", ":", ""),
    "oracle": Look("0.40", ":", ""),
}
"""Okabe and Ito's colours for conditions, greys for baselines."""
SPARE_LOOKS = tuple(Look(_hex(colour), "-", "xx") for colour in (PURPLE, RED, BLUE, GREY))
"""Of further groups, in turn."""
ACTION_HEX = tuple(_hex(colour) for colour in ACTION_COLOURS)
ACTION_HATCHES = ("", "//", "\\\\")
STAR_COLOUR = _hex(RED)


def looks_of(labels: list[str]) -> dict[str, Look]:
    """Returns how each of these groups is drawn."""
    spare = [label for label in labels if label not in LOOKS]
    found = {label: SPARE_LOOKS[number % len(SPARE_LOOKS)] for number, label in enumerate(spare)}
    return {label: found.get(label) or LOOKS[label] for label in labels}


def new_figure(width_inches: float, height_inches: float) -> Figure:
    """Returns an empty figure that needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inches, height_inches), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def plain(axes: Axes, title: str = "", x: str = "", y: str = "") -> None:
    """Gives axes their words, and takes away the frame that carries none."""
    axes.set_title(title, loc="left", fontsize=NORMAL)
    axes.set_xlabel(x, fontsize=SMALL)
    axes.set_ylabel(y, fontsize=SMALL)
    axes.tick_params(labelsize=SMALL)
    axes.spines[["top", "right"]].set_visible(False)


def save(figure: Figure, folder: Path, name: str) -> str:
    """Writes NAME.png and NAME.svg to a folder and returns the name of the PNG."""
    from matplotlib import rc_context

    figure.savefig(folder / f"{name}.png", dpi=PNG_DPI)
    with rc_context({"svg.hashsalt": name}):  # equal data give equal bytes
        figure.savefig(folder / f"{name}.svg", dpi=PNG_DPI, metadata={"Date": None})
    return f"{name}.png"
