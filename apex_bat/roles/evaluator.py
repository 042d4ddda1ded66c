"""The evaluator: judges new checkpoints by greedy flights while training runs, and keeps the best one."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import Policy
from apex_bat.evaluation.flights import fly, score
from apex_bat.recording.flight import Flight
from apex_bat.roles import checkpoint
from apex_bat.roles.plan import Assignment
from apex_bat.roles.reporting import RoleReporter
from apex_bat.storage import StorageError

_log = logging.getLogger(__name__)


def run_evaluator(assignment: Assignment) -> None:
    """Judges the newest checkpoint every `evaluation.period_s` until told to stop."""
    evaluator = Evaluator(assignment)
    try:
        while not assignment.stop.wait(0.2):
            evaluator.step()
    finally:
        evaluator.close()


class Evaluator:
    """The state of the evaluator: the policy and what it has judged already.

    Its starts differ from those of the evaluation after training, so that the choice of the best checkpoint does not
    flatter the final figures.
    """

    def __init__(self, assignment: Assignment) -> None:
        self._assignment = assignment
        config = assignment.config
        self._config = config
        self._policy = Policy(config.network, config.state_steps)
        self._reporter = RoleReporter(assignment)
        self._judged: Path | None = None
        self._due_s = time.monotonic() + config.evaluation.period_s

    def step(self) -> None:
        """Judges the newest checkpoint if the time has come and it was not judged yet."""
        if self._reporter.is_due:
            self._reporter.send("waiting for a new checkpoint")
        if time.monotonic() < self._due_s:
            return
        newest = checkpoint.find(self._assignment.run / "checkpoints")[-1:]
        if not newest or newest[0] == self._judged:
            return
        self._due_s = time.monotonic() + self._config.evaluation.period_s
        self._judge(newest[0])

    def close(self) -> None:
        """Closes the socket."""
        self._reporter.close()

    def _judge(self, path: Path) -> None:
        try:
            found = checkpoint.load(path)
        except StorageError as error:  # removed meanwhile: a newer one will come
            _log.warning("not judged: %s", error)
            return
        self._judged = path
        self._policy.load(found.policy_parameters())
        config = self._config
        num_sampled = config.recording.sampled_flights
        records, flights = fly(
            self._policy, config, config.arena, num_flights=config.evaluation.flights,
            seed=config.evaluation.start_seed + 1, num_recorded=num_sampled, checkpoint_step=found.learner_step,
            is_stopped=self._is_stopped,
        )  # fmt: skip
        if not records:
            return
        result = score(records)
        checkpoint.mark_best(path.parent, path, result)
        self._reporter.count("evaluations", 1)
        for name, value in (
            ("learner_step", found.learner_step),
            ("completed_share", result[0]),
            ("progress_m", result[1]),
            ("steps", sum(record.steps for record in records) / len(records)),
            ("return", sum(record.reward for record in records) / len(records)),
            *part_norms(found.policy_parameters()).items(),
        ):
            self._reporter.gauge(name, value)
        self._reporter.send(f"judged the checkpoint of update {found.learner_step}")
        self._record(flights)

    def _record(self, flights: list[Flight]) -> None:
        """Records the sampled flights; on a full disk the evaluation counts all the same."""
        if not flights:
            return
        from apex_bat.recording.keeping import keep_flights

        try:
            keep_flights(flights, self._config, self._assignment.run, draw=False)
        except OSError as error:
            _log.error("no recording: %s", error)

    def _is_stopped(self) -> bool:
        if self._reporter.is_due:
            self._reporter.send("flying")
        return self._assignment.stop.is_set()


def part_norms(parameters: Mapping[str, NDArray[np.float32]]) -> dict[str, float]:
    """Returns `weights_norm.PART` of each part of the network: the root of the sum of its squared parameters."""
    squares: dict[str, float] = {}
    for name, values in parameters.items():
        part = f"weights_norm.{name.partition('.')[0]}"
        squares[part] = squares.get(part, 0.0) + float(np.square(values, dtype=np.float64).sum())
    return {part: math.sqrt(total) for part, total in squares.items()}
