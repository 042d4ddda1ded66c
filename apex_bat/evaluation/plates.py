"""All figures of a report, drawn into its folder, with their captions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from apex_bat.evaluation import ear_figures, figures, print_style
from apex_bat.evaluation.document import Picture
from apex_bat.evaluation.groups import Group
from apex_bat.evaluation.results import Protocol

INFERRED = (
    "Which arenas the thesis flew in is inferred from its text and figures: simple = gym-gazebo's circuit2, narrow = "
    "the same scaled by 0.85, circle = gym-gazebo's round."
)
CAPTIONS = {
    "learning_curves": "Fig. 4.1. Greedy flights of the checkpoints judged during training, in the training arena. "
    "Dots and thin lines are runs, thick lines their mean; bands are 95 % intervals over runs, drawn from 3 on.",
    "trajectories": "Fig. 4.2. All flights of the first seed of each condition. Circles are starts, stars collisions. "
    + INFERRED,
    "behaviour": "Fig. 4.3. Above: distance to the nearest wall at each step of all flights (bar: middle half, dot: "
    "median, dotted: 0.4 m, below which a step is damage). Middle: share of actions. Below: distance flown, mean and "
    "standard error over flights, as in the thesis; dots are the means of runs. Greys are baselines.",
    "point_cloud": "Fig. 3.4. What the 3D range sensor meets at {where}; the echo is made from these points.",
    "directivity": "Fig. 3.5. Directivity of mouth and ears together, at the call's frequency.",
    "echo_chain": "Fig. 3.6. The echo at {where}, stage by stage: impulses, sound, cochlea, frame.",
    "state": "Fig. 3.7. The echoes of consecutive calls and the state that they make; t is {where}.",
    "states": "Figs. 3.9 to 3.11. What is left of that state in the three conditions, on one scale.",
}
"""Of each figure by its file name, in the order of the report; {where} is the moment that it shows."""


def draw_plates(groups: Sequence[Group], protocol: Protocol, folder: Path) -> list[Picture]:
    """Draws all figures, NAME.png and NAME.svg, and returns them with their captions."""
    trained = [each for each in groups if each.is_trained]
    first = trained[0].runs[0]
    moment = ear_figures.find_moment(first, protocol.arenas[0])
    drawn = {
        "learning_curves": figures.learning_curves(trained),
        "trajectories": figures.trajectories(trained, protocol.arenas),
        "behaviour": figures.behaviour(groups, protocol.arenas),
        "point_cloud": ear_figures.point_cloud(moment),
        "directivity": ear_figures.directivity(first.config.sonar),
        "echo_chain": ear_figures.echo_chain(moment),
        "state": ear_figures.state(moment),
        "states": ear_figures.states_of_conditions(moment),
    }
    return [
        Picture(print_style.save(drawn[name], folder, name), caption.replace("{where}", moment.where))
        for name, caption in CAPTIONS.items()
    ]
