"""The report on runs: the answer first, then tables, figures, the method, and the facts of the runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from apex_bat.evaluation.claims import ALIKE_MARK, RULES, WEAK_MARK, Finding, completed, findings, shown, shown_p
from apex_bat.evaluation.document import Block, Bullets, Heading, Paragraph, Picture, to_html, to_markdown
from apex_bat.evaluation.groups import Group, group, long_labels, thesis_groups
from apex_bat.evaluation.method import method
from apex_bat.evaluation.plates import draw_plates
from apex_bat.evaluation.results import Judged, Protocol
from apex_bat.evaluation.statistics import ENOUGH_SEEDS, bootstrap_share, least_p
from apex_bat.evaluation.tables import (
    Comparison,
    arena_table,
    baseline_table,
    compare,
    comparison_table,
    findings_table,
    overall_table,
    runs_table,
)
from apex_bat.storage import write_text

TITLE = "Training an artificial bat: the thesis's experiment repeated"
FIGURES = "figures"


def write_report(
    judged: Sequence[Judged],
    baselines: Sequence[Judged],
    protocol: Protocol,
    folder: Path,
    draw: Callable[[Sequence[Group], Protocol, Path], list[Picture]] = draw_plates,
) -> list[Path]:
    """Writes `index.html`, `report.md` and `figures/` (PNG and SVG) and returns the paths of the two documents.

    Args:
        judged: trained policies, flown by `protocol`; at least one.
        baselines: pilots that learn nothing, flown by the same.
        protocol: how all of them flew.
        folder: of the report; made if need be.
        draw: draws the figures into a folder.

    Raises:
        StorageError: it cannot be written.
    """
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    groups = group(judged, baselines)
    found = findings(thesis_groups(groups), protocol)
    comparisons = compare(groups, protocol)
    pictures = draw(groups, protocol, folder / FIGURES)
    blocks = _blocks(groups, protocol, found, comparisons, pictures)
    page, text = folder / "index.html", folder / "report.md"
    write_text(text, to_markdown(blocks, FIGURES))
    write_text(page, to_html(blocks, TITLE, folder / FIGURES))
    return [page, text]


def answer(
    groups: Sequence[Group], protocol: Protocol, found: Sequence[Finding], comparisons: Sequence[Comparison]
) -> str:
    """Returns the outcome in a paragraph: how many seeds, what reproduced and what did not, and how sure that is."""
    trained = [each for each in groups if each.is_trained]
    verdicts = Counter(each.verdict for each in found)
    sentences = []
    if verdicts["not comparable"] < len(found):
        sentences.append(
            f"Of {len(found)} numbers of the thesis {verdicts['reproduced']} are reproduced, "
            f"{verdicts['not reproduced']} are not, and {verdicts['not comparable']} cannot be compared."
        )
        for verdict in ("reproduced", "not reproduced"):
            names = [each.claim for each in found if each.verdict == verdict]
            if names:
                sentences.append(f"{verdict[0].upper()}{verdict[1:]}: {'; '.join(names)}.")
    else:
        reasons = Counter(each.reason for each in found)
        sentences.append(
            f"These runs do not tell whether the thesis is reproduced: none of its {len(found)} numbers can be "
            f"compared with them (mainly: {reasons.most_common(1)[0][0]})."
        )
    sentences.append(f"Seeds: {', '.join(f'{each.label} {each.num_seeds}' for each in trained)}.")
    shares = [
        f"{each.label} {shown(bootstrap_share(each.scores(protocol.arenas, completed)), 100.0, ' %')}"
        for each in groups
    ]
    sentences.append(f"Flights completed in {', '.join(protocol.arenas)} together: {'; '.join(shares)}.")
    sentences += _compared(comparisons, trained)
    text = " ".join(sentences)
    notes = {
        WEAK_MARK: f"An interval from fewer than {ENOUGH_SEEDS} seeds.",
        ALIKE_MARK: "No resample differs: a share whose flights all ended alike has Wilson's interval, as if flights "
        "were independent; any other number none that tells how sure it is.",
    }
    return " ".join([text, *(f"{mark} {note}" for mark, note in notes.items() if mark in text)])


def _compared(comparisons: Sequence[Comparison], trained: Sequence[Group]) -> list[str]:
    """Sentences on the pairs of conditions that are held against the thesis, by completed flights."""
    judged = {each.label for each in thesis_groups(trained).values()}
    seeds = {each.label: each.num_seeds for each in trained}
    sentences = []
    for each in comparisons:
        if each.what != "flights completed" or not {each.first, each.second} <= judged:
            continue
        text = f"{each.first} less {each.second}: {shown(each.difference, 100.0, ' points')}"
        if each.corrected_p == each.corrected_p:  # not NaN
            least = least_p(seeds[each.first], seeds[each.second])
            text += f", p = {shown_p(each.corrected_p)} (Holm; one test alone can reach {shown_p(least)} at best)"
        sentences.append(f"{text} ({each.remark})." if each.remark else f"{text}.")
    return sentences


def _blocks(
    groups: Sequence[Group],
    protocol: Protocol,
    found: Sequence[Finding],
    comparisons: Sequence[Comparison],
    pictures: Sequence[Picture],
) -> list[Block]:
    conditions, against = comparison_table(comparisons), baseline_table(comparisons)
    return [
        Heading(TITLE, 1),
        Paragraph(answer(groups, protocol, found, comparisons), is_answer=True),
        Heading("The thesis's numbers beside these"),
        findings_table(found),
        Heading("How the bats fly"),
        overall_table(groups, protocol),
        arena_table(groups, protocol),
        Heading("Conditions compared"),
        conditions if conditions.rows else Paragraph("There is one condition only."),
        against,
        Heading("Figures"),
        *pictures,
        Heading("Method"),
        *method(groups, protocol),
        Heading("Rules of the verdicts", 3),
        Bullets(RULES),
        Heading("The runs"),
        runs_table(groups),
        *(Paragraph(f"{label} differs from the default in {words}.") for label, words in long_labels(groups).items()),
    ]
