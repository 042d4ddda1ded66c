"""Layouts of the viewer: *flight* (default), *ear* (one call, every stage large), *policy*, and two side by side."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import rerun.blueprint as rrb

from apex_bat.config import Config
from apex_bat.recording.curves import EPSILON_PATH, EVENTS_PATH, HISTOGRAM_NAME, LADDER_PATH
from apex_bat.recording.series import EAR_NAMES
from apex_bat.recording.views import HIDDEN, Views, curves, events, priorities_now, priorities_over_time
from apex_bat.simulation.layout import Arena

APPLICATION_ID = "apex_bat"
CHAIN = (
    ("waveform", "1 Sound [Pa over ms]"),
    ("gammatone", "2 Gammatone channel at the call's frequency [Pa]"),
    ("rectified", "3 Rectified [Pa]"),
    ("compressed", "4 Compressed, x^0.4"),
    ("envelope", "5 Low-passed at 1 kHz"),
    ("frame", "6 Echo frame: means over 1 ms"),
)
"""The chain of thesis fig. 3.6: entity of each stage and its name."""


def flight_blueprint(arena: Arena | None = None, *, is_playing: bool = False) -> rrb.Blueprint:
    """Returns the default layout: chase view and map, both ears, state, values, actions, reward, clearance.

    It begins paused, or playing in real time.
    """
    views = Views(arena)
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Horizontal(views.chase(), views.map()),
                views.actions(close_up=True),
                rrb.Horizontal(views.clearance(), views.reward(close_up=True)),
                row_shares=[5, 1, 2],
            ),
            rrb.Vertical(
                rrb.Horizontal(*map(views.waveform, EAR_NAMES)),
                rrb.Horizontal(*map(views.cochleagram, EAR_NAMES)),
                views.state(),
                views.q(close_up=True),
                row_shares=[2, 2, 2, 2],
            ),
            column_shares=[5, 4],
        ),
        play_state="playing" if is_playing else "paused",
    )


def ear_blueprint(arena: Arena | None = None) -> rrb.Blueprint:
    """Returns the layout of one call: levels of the points and cochleagrams, and the stages of each ear in a column."""
    views = Views(arena)
    seen = rrb.Vertical(*map(views.points, EAR_NAMES), *map(views.cochleagram, EAR_NAMES), row_shares=[3, 3, 3, 3])
    chains = [
        rrb.Vertical(
            *(views.stage(stage, ear, f"{name}, {ear}") for stage, name in CHAIN), row_shares=[5, 5, 4, 4, 4, 4]
        )
        for ear in EAR_NAMES
    ]
    return _blueprint(rrb.Horizontal(seen, *chains, column_shares=[3, 4, 4]))


def policy_blueprint(arena: Arena | None = None) -> rrb.Blueprint:
    """Returns the layout of decisions: state, Q values, value, advantages, actions, reward and what came of them.

    Values and actions are shown around the cursor, what came of them over the whole flight.
    """
    views = Views(arena)
    return _blueprint(
        rrb.Horizontal(
            rrb.Vertical(views.state(), views.map(), row_shares=[1, 2.6]),
            rrb.Vertical(
                views.q(close_up=True),
                views.value(),
                views.advantage(),
                views.reward(close_up=True),
                views.actions(close_up=True),
                row_shares=[3, 2, 3, 2, 1.3],
            ),
            rrb.Vertical(views.returns(), views.clearance(), views.progress(), views.events()),
            column_shares=[4, 5, 4],
        )
    )


def pair_blueprint(arena: Arena | None, names: tuple[str, str], view: str = "flight") -> rrb.Blueprint:
    """Returns a layout of two flights side by side, whose entities lie below `a` and `b`.

    Args:
        arena: what the maps are centred on.
        names: of the flights.
        view: a key of `PAIR_COLUMNS`.
    """
    columns = [PAIR_COLUMNS[view](Views(arena, prefix, name)) for prefix, name in zip(PAIR, names, strict=True)]
    return _blueprint(rrb.Horizontal(*columns))


def _flight_column(views: Views) -> rrb.Vertical:
    return rrb.Vertical(
        rrb.Horizontal(views.chase(), views.map()),
        views.state(),
        views.q(close_up=True),
        views.actions(close_up=True),
        views.clearance(),
        row_shares=[5.2, 3.5, 2.8, 1.7, 2.5],
    )


def _ear_column(views: Views) -> rrb.Vertical:
    return rrb.Vertical(
        rrb.Horizontal(*map(views.points, EAR_NAMES)),
        rrb.Horizontal(*map(views.waveform, EAR_NAMES)),
        rrb.Horizontal(*map(views.cochleagram, EAR_NAMES)),
        rrb.Horizontal(*(views.stage("frame", ear, f"Echo frame, {ear}") for ear in EAR_NAMES)),
        views.state(),
        row_shares=[3.8, 2.8, 3.4, 2.5, 3.5],
    )


def _policy_column(views: Views) -> rrb.Vertical:
    return rrb.Vertical(
        rrb.Horizontal(views.state(), views.map(), column_shares=[3, 2]),
        views.q(close_up=True),
        rrb.Horizontal(views.value(), views.advantage()),
        views.actions(close_up=True),
        rrb.Horizontal(views.returns(), views.progress()),
        row_shares=[4.4, 3, 2.8, 1.7, 2.8],
    )


PAIR_COLUMNS = {"flight": _flight_column, "ear": _ear_column, "policy": _policy_column}
"""The layouts that two flights may have side by side."""


def list_recordings(blueprint: rrb.Blueprint) -> rrb.Blueprint:
    """Returns the layout with the list of the recordings that are open, from which one is chosen."""
    blueprint.blueprint_panel = rrb.BlueprintPanel(state="expanded")
    return blueprint


def training_blueprint(config: Config) -> rrb.Blueprint:
    """Returns the layout of the course of a training."""
    actors = [f"actor-{number}" for number in range(config.actors)]
    below, above = rrb.Corner2D.RightBottom, rrb.Corner2D.LeftTop
    exploring: rrb.View = rrb.BarChartView(name="Epsilon of each bat", origin=LADDER_PATH, plot_legend=HIDDEN)
    if config.exploration.kind == "anneal":
        exploring = curves("Epsilon of all bats", EPSILON_PATH)
    priorities = f"replay/{HISTOGRAM_NAME}"
    return _blueprint(
        rrb.Grid(
            curves("Return in training: all bats", *(f"{actor}/return" for actor in actors), legend=below),
            curves("Return in training: greedy bats", *(f"{actor}/return_greedy" for actor in actors), legend=below),
            curves("Test flights: share complete", "evaluator/completed_share", top=1.0),
            curves("Test flights: progress [m]", "evaluator/progress_m"),
            curves("Loss", "learner/loss"),
            curves("Mean Q of the sampled actions", "learner/q_mean"),
            curves("Norm of the gradient", "learner/gradient_norm"),
            curves("Norms of the weights", "learner/weights_norm", legend=below),
            curves("Steps and updates [1/s]", *(f"{actor}/rate" for actor in actors), "learner/rate", legend=above),
            curves("Transitions in and out of the replay [1/s]", "replay/rate", legend=above),
            curves("Samples per insert", "replay/samples_per_insert", top=_labelled(config.replay.samples_per_insert)),
            curves("Policy lag [updates]", "replay/policy_lag"),
            rrb.Tabs(priorities_over_time(priorities), priorities_now(priorities), active_tab=0),
            exploring,
            rrb.Tabs(
                curves("Learner's idle share", "learner/idle_share"),
                curves("Transitions held", "replay/size"),
                curves("Exponents alpha and beta", "replay/exponents", legend=above),
                active_tab=0,
            ),
            events("Events", EVENTS_PATH, "elapsed", with_level=False),
            grid_columns=4,
        ),
        timeline="elapsed",
        play_state="following",  # at the end, and there too while more comes
    )


PAIR = ("a", "b")
"""First parts of the entity paths of two flights side by side."""
BLUEPRINTS = {"flight": flight_blueprint, "ear": ear_blueprint, "policy": policy_blueprint}


def save_blueprints(folder: Path, arena: Arena | None = None) -> list[Path]:
    """Writes flight.rbl, ear.rbl and policy.rbl into a folder, and returns their paths.

    Name one after the recordings, because the last layout wins: `rerun recordings/*.rrd recordings/ear.rbl`. With an
    arena the map is centred on it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, make in BLUEPRINTS.items():
        paths.append(folder / f"{name}.rbl")
        make(arena).save(APPLICATION_ID, paths[-1])
    return paths


def _labelled(value: float) -> float:
    """The end of an axis somewhat beyond a value: 1, 2, 5, 10, 20, ..., which the viewer labels on small panels too."""
    decade = 10.0 ** math.floor(math.log10(value))
    return next(step * decade for step in (1.0, 2.0, 5.0, 10.0, 20.0) if step * decade >= 1.1 * value)


def _blueprint(
    root: rrb.Container, timeline: str = "step", play_state: Literal["paused", "playing", "following"] = "paused"
) -> rrb.Blueprint:
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, fps=20, play_state=play_state),
    )
