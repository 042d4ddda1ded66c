"""The course of a training as a rerun recording: losses, returns, lag, rates, norms, exploration, priorities.

It is made from the rows of `metrics/*.jsonl`, by the launcher while it writes them or by whoever reads them later, and
belongs to an application of its own, because a layout belongs to an application.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from apex_bat.agent.exploration import annealed, ladder
from apex_bat.config import Config
from apex_bat.recording.priorities import (
    PriorityImage,
    PriorityMap,
    log_priorities_style,
    send_histograms,
    send_images,
)
from apex_bat.recording.series import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Rgb
from apex_bat.replay.metrics import PRIORITY_BINS

TRAINING_APPLICATION_ID = "apex_bat_training"
PALETTE: tuple[Rgb, ...] = (BLUE, ORANGE, GREEN, PURPLE, RED, GREY)
MEAN_S = 15.0
"""Seconds of returns that are averaged: a row holds those of a few episodes only, which is mostly noise."""
IMAGE_PERIOD_S = 10.0
"""Seconds between images of the priorities over time, each of 4 KB."""
HISTOGRAM_PREFIX = "replay.priority_hist."
"""Metrics of the replay that start so are the shares of a histogram's bins, ordered by the number after it."""
HISTOGRAM_NAME = "priorities"
"""Entity of the histogram below the role's name."""
EPSILON_PATH = "exploration/epsilon"
LADDER_PATH = "exploration/ladder"
EVENTS_PATH = "events"


class _Moment(NamedTuple):
    """When a row was written, on the three timelines."""

    env_steps: int
    learner_step: int
    elapsed_s: float


class _Row(NamedTuple):
    moment: _Moment
    values: list[float]


class Curve(NamedTuple):
    """One entity of one or several scalars of a role."""

    name: str
    """Entity below the role's name."""
    metrics: tuple[str, ...]
    """Figures of the role's rows, as docs/metrics.md has them; `d NAME` is the growth of NAME a second, `mean NAME` its
    mean over 15 s, each episode counted once."""


CURVES: dict[str, tuple[Curve, ...]] = {
    "actor": (
        Curve("return", ("mean return",)),
        Curve("return_greedy", ("mean return_greedy",)),
        Curve("rate", ("env_steps_per_s",)),
    ),
    "learner": (
        Curve("loss", ("loss",)),
        Curve("gradient_norm", ("gradient_norm",)),
        Curve("q_mean", ("q_mean",)),
        Curve("rate", ("updates_per_s",)),
        Curve("idle_share", ("share.waiting",)),
        Curve("weights_norm", ("weights_norm.filters", "weights_norm.value", "weights_norm.advantage")),
    ),
    "replay": (
        Curve("samples_per_insert", ("replay.samples_per_insert",)),
        Curve("policy_lag", ("replay.policy_lag",)),
        Curve("size", ("replay.size",)),
        Curve("rate", ("d replay.inserted", "d replay.sampled")),
        Curve("exponents", ("replay.alpha", "replay.beta")),
    ),
    "evaluator": (
        Curve("completed_share", ("completed_share",)),
        Curve("progress_m", ("progress_m",)),
        Curve("return", ("return",)),
    ),
}
"""The entities of each kind of role."""


class TrainingCurves:
    """Turns rows of metrics into entities of a recording; rows are gathered until `flush`."""

    def __init__(self, recording: rr.RecordingStream, config: Config, name: str) -> None:
        """Logs what never changes: the ladder of epsilons, and the run's name.

        Args:
            recording: where to.
            config: settings of the run.
            name: of the run.
        """
        self._recording, self._config = recording, config
        self._rows: defaultdict[str, list[_Row]] = defaultdict(list)
        self._events: list[tuple[_Moment, str]] = []
        self._known: dict[str, Mapping[str, Any]] = {}
        self._means: dict[tuple[str, str], _Mean] = {}
        self._styled: set[str] = set()
        self._maps: dict[str, PriorityMap] = {}
        self._drawn: defaultdict[str, list[tuple[_Moment, PriorityImage]]] = defaultdict(list)
        self._drawn_s: dict[str, float] = {}
        recording.send_recording_name(name)
        if config.exploration.kind == "ladder":
            epsilons = ladder(config.actors * config.bats_per_actor, config.exploration)
            recording.log(LADDER_PATH, rr.BarChart(epsilons, color=BLUE), static=True)

    def take(self, row: Mapping[str, Any]) -> None:
        """Takes a row of metrics; one of an unknown role is ignored."""
        role = str(row["role"])
        moment = _Moment(int(row["env_steps_total"]), int(row["learner_step_total"]), float(row["elapsed_s"]))
        before = self._known.get(role)
        for curve in CURVES.get(role.partition("-")[0], ()):
            values = [self._figure(metric, row, before, moment) for metric in curve.metrics]
            if not all(map(math.isnan, values)):
                self._gather(f"{role}/{curve.name}", moment, values, curve.metrics)
        histogram = sorted((name for name in row if name.startswith(HISTOGRAM_PREFIX)), key=_histogram_place)
        if len(histogram) == PRIORITY_BINS:
            self._take_priorities(f"{role}/{HISTOGRAM_NAME}", moment, [float(row[name]) for name in histogram])
        if self._config.exploration.kind == "anneal" and role == "learner":
            epsilon = annealed(moment.env_steps, self._config.exploration)
            self._gather(EPSILON_PATH, moment, [epsilon], ("epsilon",))
        self._events += [(moment, f"{_clock(moment.elapsed_s)} {text}") for text in _events(row, before)]
        self._known[role] = row

    def flush(self) -> None:
        """Sends what was gathered."""
        for path, rows in self._rows.items():
            values = np.array([row.values for row in rows])
            times = _times([row.moment for row in rows])
            if path in self._maps:
                send_histograms(self._recording, path, values, times)
            else:
                columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition([values.shape[1]] * len(values))
                self._recording.send_columns(path, times, columns)
        for path, drawn in self._drawn.items():
            moments, images = zip(*drawn, strict=True)
            send_images(self._recording, path, images, _times(list(moments)))
        if self._events:
            times = _times([moment for moment, _ in self._events])
            self._recording.send_columns(
                EVENTS_PATH, times, rr.TextLog.columns(text=[text for _, text in self._events])
            )
        self._events.clear()
        self._rows.clear()
        self._drawn.clear()

    def _take_priorities(self, path: str, moment: _Moment, shares: list[float]) -> None:
        """Takes a histogram; now and then the image of all so far is drawn."""
        over_time = self._maps.setdefault(path, PriorityMap())
        over_time.take(shares, moment.elapsed_s)
        self._gather(path, moment, shares, ())
        if moment.elapsed_s >= self._drawn_s.get(path, -math.inf) + IMAGE_PERIOD_S:
            self._drawn_s[path] = moment.elapsed_s
            self._drawn[path].append((moment, over_time.draw()))

    def _gather(self, path: str, moment: _Moment, values: list[float], names: tuple[str, ...]) -> None:
        if path not in self._styled:
            self._styled.add(path)
            self._log_style(path, names)
        self._rows[path].append(_Row(moment, values))

    def _figure(self, metric: str, row: Mapping[str, Any], before: Mapping[str, Any] | None, moment: _Moment) -> float:
        """A figure of a row; NaN when it has none."""
        how, _, name = metric.rpartition(" ")
        if how == "d":
            return _growth_per_s(name, row, before)
        if how == "mean":
            mean = self._means.setdefault((str(row["role"]), name), _Mean(moment.elapsed_s))
            return mean.take(row.get(name), float(row.get(f"{name}_count", 1.0)), moment.elapsed_s)
        return float(row.get(name, math.nan))

    def _log_style(self, path: str, names: tuple[str, ...]) -> None:
        """Logs once the names and colours of an entity's lines; the first actors have colours of their own."""
        if path in self._maps:
            log_priorities_style(self._recording, path)
            return
        role = path.partition("/")[0]
        _, _, number = role.partition("-")
        first = int(number) if number.isdecimal() else len(PALETTE) - 3
        labels = [f"{role} {name.rpartition(' ')[2].rpartition('.')[2]}" for name in names]
        colours = [PALETTE[(first + i) % len(PALETTE)] for i in range(len(names))]
        style = rr.SeriesLines(names=labels, colors=colours, widths=[1.5] * len(names))
        self._recording.log(path, style, static=True)


class _Mean:
    """The mean of a figure over some seconds, each row weighed by how many values it is the mean of."""

    def __init__(self, since_s: float) -> None:
        self._since_s, self._total, self._weight = since_s, 0.0, 0.0

    def take(self, value: float | None, weight: float, now_s: float) -> float:
        """Takes a row's value, if it has one; returns the mean when its time is over, else NaN."""
        if value is not None:
            self._total += weight * value
            self._weight += weight
        if now_s - self._since_s < MEAN_S or self._weight == 0.0:
            return math.nan
        mean = self._total / self._weight
        self._since_s, self._total, self._weight = now_s, 0.0, 0.0
        return mean


def _events(row: Mapping[str, Any], before: Mapping[str, Any] | None) -> Iterator[str]:
    """What a row tells beside its figures: a new process, a checkpoint judged."""
    if before is None or before["pid"] != row["pid"]:
        yield f"{row['role']}: process {row['pid']} {'started' if before is None else 'took over'}"
    if str(row["state"]).startswith("judged"):
        share, way_m = row.get("completed_share", math.nan), row.get("progress_m", math.nan)
        yield f"update {row.get('learner_step', math.nan):.0f}: {100 * share:.0f} % complete, {way_m:.0f} m"


def _clock(elapsed_s: float) -> str:
    return f"{int(elapsed_s // 60)}:{int(elapsed_s % 60):02}"


def _growth_per_s(name: str, row: Mapping[str, Any], before: Mapping[str, Any] | None) -> float:
    """How a counter grew a second since the row before of the same process."""
    if before is None or before["pid"] != row["pid"] or name not in row or name not in before:
        return math.nan
    passed_s = row["unix_s"] - before["unix_s"]
    return float((row[name] - before[name]) / passed_s) if passed_s > 0.0 else math.nan


def _histogram_place(name: str) -> float:
    """The number at the end of a histogram's metric; infinity for one without."""
    try:
        return float(name.removeprefix(HISTOGRAM_PREFIX))
    except ValueError:
        return math.inf


def _times(moments: list[_Moment]) -> list[rr.TimeColumn]:
    env_steps, learner_steps, seconds = (np.array(column) for column in zip(*moments, strict=True))
    return [
        rr.TimeColumn("env_steps", sequence=env_steps),
        rr.TimeColumn("learner_step", sequence=learner_steps),
        rr.TimeColumn("elapsed", duration=seconds),
    ]
