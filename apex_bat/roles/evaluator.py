"""The evaluator: judges new checkpoints by greedy flights while training runs, and keeps the best one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from apex_bat.agent.inference import Policy
from apex_bat.roles import checkpoint
from apex_bat.roles.plan import Assignment
from apex_bat.roles.reporting import RoleReporter
from apex_bat.storage import State, StorageError, joined, part_of

if TYPE_CHECKING:
    from apex_bat.recording.flight import Flight

OTHER_STARTS = 1_000_000
"""Added to the seed of the starts. Flight k begins where seed + k says, so seeds must lie farther apart than the number
of flights, or the best checkpoint is chosen by the very flights that judge it in the end."""
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

    def __init__(
        self,
        assignment: Assignment,
        reporter: RoleReporter | None = None,
        between_steps: Callable[[], None] = lambda: None,
    ) -> None:
        """Takes the evaluator's part of the run.

        Args:
            assignment: the role, the run and its settings.
            reporter: tells what it does; None: one that reports where the assignment says.
            between_steps: is called before each step of all flights, for who has something else to do meanwhile.
        """
        self._assignment = assignment
        config = assignment.config
        self._config = config
        self._between_steps = between_steps
        self._policy = Policy(config.network, config.state_steps)
        self._reporter = reporter or RoleReporter(assignment)
        self._judged = ""  # name of the checkpoint
        self._due_s = assignment.clock() + config.evaluation.period_s

    def step(self) -> bool:
        """Judges the newest checkpoint if the time has come and it was not judged yet.

        Returns:
            False if it was told to stop meanwhile; it has broken off then and is as it was before.
        """
        if self._reporter.is_due:
            self._reporter.send("waiting for a new checkpoint")
        begun_s = self._assignment.clock()
        if begun_s < self._due_s:
            return True
        newest = checkpoint.find(self._assignment.run / "checkpoints")[-1:]
        if not newest or newest[0].name == self._judged:
            return True
        if not self._judge(newest[0]):
            return False
        self._due_s = begun_s + self._config.evaluation.period_s
        self._judged = newest[0].name
        return True

    def state(self) -> State:
        """Returns all that the evaluator continues from, for `restore`."""
        own = State({"judged": self._judged, "due_s": self._due_s}, {})
        return joined({"self": own, "reporter": self._reporter.state()})

    def restore(self, state: State) -> None:
        """Continues from what `state` returned."""
        values, _ = part_of(state, "self")
        self._judged, self._due_s = values["judged"], values["due_s"]
        self._reporter.restore(part_of(state, "reporter"))

    def close(self) -> None:
        """Closes the socket."""
        self._reporter.close()

    def _judge(self, path: Path) -> bool:
        """Judges a checkpoint; returns False if it was told to stop meanwhile."""
        # Here: what flies takes 2 s to import, which at the start of a run the actors and the learner need themselves.
        from apex_bat.evaluation.flights import fly, score

        try:
            found = checkpoint.load(path)
        except StorageError as error:  # removed meanwhile: a newer one will come
            _log.warning("not judged: %s", error)
            return True
        self._policy.load(found.policy_parameters())
        config = self._config
        num_sampled = config.recording.sampled_flights
        records, flights = fly(
            self._policy, config, config.arena, num_flights=config.evaluation.flights,
            seed=config.evaluation.start_seed + OTHER_STARTS, num_recorded=num_sampled,
            checkpoint_step=found.learner_step, is_stopped=self._is_stopped,
        )  # fmt: skip
        if not records:
            return False
        result = score(records)
        try:
            checkpoint.mark_best(path.parent, found, result)
        except StorageError as error:
            _log.error("the best checkpoint is not kept: %s", error)
        self._reporter.count("evaluations", 1)
        for name, value in (
            ("learner_step", found.learner_step),
            ("completed_share", result[0]),
            ("progress_m", result[1]),
            ("steps", sum(record.steps for record in records) / len(records)),
            ("return", sum(record.reward for record in records) / len(records)),
        ):
            self._reporter.gauge(name, value)
        self._reporter.send(f"judged the checkpoint of update {found.learner_step}")
        self._record(flights)
        return True

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
        self._between_steps()
        return self._assignment.stop.is_set()
