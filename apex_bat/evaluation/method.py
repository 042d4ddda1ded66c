"""How the numbers of a report came about, in paragraphs: said of all runs, also where they are not alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from apex_bat.evaluation.claims import ALIKE_MARK, WEAK_MARK
from apex_bat.evaluation.document import Block, Paragraph
from apex_bat.evaluation.groups import Group, settings_apart
from apex_bat.evaluation.plates import INFERRED
from apex_bat.evaluation.results import Judged, Protocol
from apex_bat.evaluation.statistics import COVERAGE, COVERAGE_SPREADS, ENOUGH_SEEDS, NUM_RESAMPLES

SENSED = ("body.", "rays.", "sonar.", "sensing.", "episode.")
"""Settings that a baseline flies with too."""


def method(groups: Sequence[Group], protocol: Protocol) -> list[Block]:
    """Returns the paragraphs: the source, how policies were chosen and flown, statistics, baselines."""
    return [
        Paragraph(
            "Mohan & Vanderelst (2020), Training an artificial bat: modeling sonar-based obstacle avoidance using deep "
            f"reinforcement learning. {INFERRED}"
        ),
        Paragraph(_flown([run for each in groups if each.is_trained for run in each.runs], protocol)),
        Paragraph(_reckoned(groups)),
        Paragraph(_baselines(groups)),
    ]


def _flown(runs: Sequence[Judged], protocol: Protocol) -> str:
    """Says which checkpoint of each training flew, and how."""

    def values(value: Callable[[Judged], object]) -> str:
        return " or ".join(sorted({str(value(run)) for run in runs}))

    counts = [run.num_judged for run in runs if run.num_judged]
    unjudged = len(runs) - len(counts)
    chosen = []
    if counts:
        span = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
        chosen.append(
            f"Of each the checkpoint was chosen that flew best in the training arena among the {span} that were "
            "judged during training, from starts of their own. (Runs trained before the evaluator had starts of its "
            "own chose by 14 of the 15 starts that are flown here in the training arena, which flatters them there.)"
        )
    if unjudged:
        chosen.append(f"Of {unjudged} of {len(runs)} runs no checkpoint was judged: the newest was taken.")
    return (
        f"The policies were trained in {values(lambda run: run.config.arena)}. {' '.join(chosen)} It was flown "
        f"greedily {protocol.num_flights} times in each of {', '.join(protocol.arenas)}, from the same random safe "
        f"poses (seed {protocol.start_seed}) for every condition, seed and baseline, until "
        f"{values(lambda run: run.config.episode.evaluation_steps)} steps or contact with a wall. Echoes were rendered "
        f"by {values(lambda run: run.config.sonar.rendering)}."
    )


def _reckoned(groups: Sequence[Group]) -> str:
    """Says what intervals mean and how far they may be trusted."""
    few = [each.label for each in groups if each.is_trained and each.num_seeds < ENOUGH_SEEDS]
    marked = f" Here that is so for {', '.join(few)}." if few else ""
    spreads = _listed([f"{100 * spread:.0f}" for spread in COVERAGE_SPREADS])
    coverage = ", ".join(
        f"{_listed([f'{100 * share:.0f}' for share in shares])} % (of {number} seeds)"
        for number, shares in COVERAGE.items()
    )
    return (
        "The unit is the seed: flights of one policy are no independent evidence on its training. Intervals are "
        f"95 % percentiles of {NUM_RESAMPLES} hierarchical bootstrap resamples, which draw seeds within each "
        "condition, and the starts of each arena once for all. They are called 95 % and are not quite: in simulations "
        f"where the shares of seeds spread with standard deviations of {spreads} points, they held the true share "
        f"{coverage} of the time. With one seed no interval is given; with fewer than {ENOUGH_SEEDS} it is marked "
        f"{WEAK_MARK}.{marked} Where all flights of a condition ended alike, resamples do not differ: a share has "
        f"Wilson's interval instead, as if its flights were independent, marked {ALIKE_MARK}; any other interval "
        f"marked {ALIKE_MARK} has no width, because no resample differs, and says nothing of how sure its number is. "
        "Interquartile mean and probability of improvement are those of Agarwal et al. (2021)."
    )


def _baselines(groups: Sequence[Group]) -> str:
    """Says what the baselines are and in which body they flew."""
    text = (
        "Baselines: random actions; straight on; ild turns away from the ear that hears more of the near echoes "
        "(Mansour et al. 2019); oracle plans on the range sensor, which no bat here perceives, and shows what the "
        "arenas allow."
    )
    flown = [each.runs[0].config for each in groups if not each.is_trained]
    if not flown:
        return text
    others = [
        each.label
        for each in groups
        if each.is_trained and any(line.startswith(SENSED) for line in settings_apart(each.runs[0].config, flown[0]))
    ]
    apart = f" {', '.join(others)} flew with others: compare them with these baselines with care." if others else ""
    return f"{text} They flew with body, rays, ear and time limit of the first run given.{apart}"


def _listed(words: Sequence[str]) -> str:
    return f"{', '.join(words[:-1])} and {words[-1]}"
