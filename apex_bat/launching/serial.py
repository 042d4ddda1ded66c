"""Training with every role in this process, in lock step: equal seeds give equal bytes.

A turn is: the evaluator looks, the learner makes the updates that inserts have earned, one actor takes one step. Time
is simulated: a step of all actors takes `body.call_interval_s`, so that periods in seconds depend on nothing outside.
Only limits by the wall clock and the live view look at it. After a stop at any moment the run continues from its last
saved state, and all that follows is what would have followed. What a full disk does not take is left out, as in a run
of processes; what is learned does not change with it.
"""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from types import FrameType

from msgspec import structs

from apex_bat.config import Config, ConfigError
from apex_bat.launching.course import Ended, Outcome
from apex_bat.launching.live import View
from apex_bat.launching.local import heeded
from apex_bat.launching.serial_reports import SerialReports
from apex_bat.launching.serial_state import SavedRun, put_back, read_newest, write
from apex_bat.launching.standing import Origin
from apex_bat.replay.store import ReplayStore
from apex_bat.roles.actor import Actor
from apex_bat.roles.evaluator import Evaluator
from apex_bat.roles.learner import Learner, new_agent
from apex_bat.roles.logs import launcher_log
from apex_bat.roles.plan import Addresses, Assignment, Role
from apex_bat.roles.reporting import RoleReporter
from apex_bat.roles.serial import BoardReader, StoreSink, StoreSource, WeightsBoard
from apex_bat.storage import Continuing, State, StorageError, joined, part_of

_log = logging.getLogger(__name__)


def train(config: Config, run: Path, view: View, *, is_resumed: bool = False) -> Ended:
    """Trains in a run folder made by `runs.create` until a limit or Ctrl-C.

    Args:
        config: the settings.
        run: the run folder.
        view: shows the run.
        is_resumed: whether to go on from the newest saved state.

    Raises:
        ConfigError: the settings ask for what has no equal bits.
        StorageError: there is no sound state to go on from, or the disk is full when it begins.
    """
    stop = threading.Event()
    with _stopping(stop), launcher_log(run, config.launch), ExitStack() as stack:
        serial = SerialRun(settings_of(config), run, stop, stack, is_resumed=is_resumed)
        stack.enter_context(view)
        return serial.follow(view)


def settings_of(config: Config) -> Config:
    """Returns the settings with which a serial run computes: on the CPU.

    Raises:
        ConfigError: they ask for CUDA, whose sums come in no fixed order.
    """
    if config.device == "cuda":
        raise ConfigError("device is cuda, and the serial mode promises equal bits, which CUDA does not: set it to cpu")
    return structs.replace(config, device="cpu")


class SerialRun:
    """All roles of one run, their lines, and whose turn it is."""

    def __init__(
        self, config: Config, run: Path, stop: threading.Event, stack: ExitStack, *, is_resumed: bool = False
    ) -> None:
        """Makes the roles, which `stack` closes; arguments and errors are those of `train`."""
        self._config, self._run, self._stop = config, run, stop
        self._view: View | None = None
        self._num_turns = 0
        self._has_looked = False  # whether the evaluator has had its part of this turn
        replay = self._assignment(Role("replay", 0))
        self.store = ReplayStore(config, replay.generator())
        saved = read_newest(run, self.store) if is_resumed else None
        if is_resumed and saved is None:
            raise StorageError(f"{run}: there is no saved state to go on from")
        if saved is not None:
            put_back(run, saved)  # before the recording of the training reads the metrics
        before_s = 0.0 if saved is None else float(saved.state.values["self"]["wall_elapsed_s"])
        counters = lambda: (self.env_steps, self.num_updates)  # noqa: E731
        self._reports = SerialReports(config, run, self.now_s, counters, Origin(elapsed_s=before_s))
        stack.callback(self._reports.close)
        self._replay_reporter = self._reporter(replay)
        self._board = WeightsBoard()
        self._source = StoreSource(self.store, config.learner.batch_size)
        learner = self._assignment(Role("learner", 0))
        self._learner = Learner(learner, new_agent(learner), 0, self._source, self._board, self._reporter(learner))
        self._sinks: list[StoreSink] = []
        self._looks: list[BoardReader] = []
        self._actors: list[Actor] = []
        for number in range(config.actors):
            actor = self._assignment(Role("actor", number))
            self._sinks.append(StoreSink(self.store, actor.role.name))
            self._looks.append(BoardReader(self._board))
            made = Actor(actor, self._sinks[-1], self._looks[-1], self._reporter(actor))
            self._actors.append(stack.enter_context(closing(made)))
        self._evaluator: Evaluator | None = None
        if config.evaluation.during_training:
            evaluator = self._assignment(Role("evaluator", 0))
            self._evaluator = Evaluator(evaluator, self._reporter(evaluator), self._show)
        if saved is not None:
            self._restore(saved)
        self._save_due_s = self.now_s() + (config.replay.snapshot_period_s or float("inf"))

    @property
    def env_steps(self) -> int:
        """Environment steps of all bats."""
        return self._num_turns * self._config.bats_per_actor

    @property
    def num_updates(self) -> int:
        """Updates of the network."""
        return self._learner.num_updates

    def now_s(self) -> float:
        """Returns the simulated time since the first step: each actor's step is its share of one of all actors."""
        return self._num_turns * self._config.body.call_interval_s / self._config.actors

    def follow(self, view: View) -> Ended:
        """Goes on until a limit or Ctrl-C."""
        outcome: Outcome = "completed"
        self._view = view
        try:
            while not self._is_over():
                self.turn()
                self._show()
                if self._stop.is_set():
                    outcome = "interrupted"
                    break
                if self.now_s() >= self._save_due_s:
                    self.save()
            self.end()
        except KeyboardInterrupt:
            _log.warning("interrupted again: nothing more is saved")
            outcome = "interrupted"
        self._reports.end()
        reason = "interrupted" if outcome == "interrupted" else ""
        return Ended(outcome, reason, self.env_steps, self.num_updates, self._reports.wall_elapsed_s)

    def turn(self) -> None:
        """Takes a turn. Broken off before the actor's step, it leaves all so that it can be taken again."""
        if self._evaluator is not None and not self._has_looked:
            self._has_looked = self._evaluator.step()
        while not self._stop.is_set() and not self._learner.is_done and self._source.is_owed:
            self._learner.step(0.0)
        if self._stop.is_set() or self._learner.is_done:
            return
        actor = self._actors[self._num_turns % self._config.actors]
        if not actor.is_ready(0.0):
            raise AssertionError("an actor waits although it is its turn")
        self._num_turns += 1  # before the step: what it reports, it has flown
        self._has_looked = False
        actor.step()
        if self._replay_reporter.is_due:
            self._report_replay("serving")

    def _show(self) -> None:
        """Shows how the run stands, also within the long part of a turn, its evaluation."""
        if self._view is not None:
            self._reports.show(self._view)

    def _is_over(self) -> bool:
        """Whether a limit is reached."""
        most = self._config.train.max_env_steps
        is_flown = most is not None and self.env_steps >= most
        return is_flown or self._learner.is_done or self._reports.is_out_of_time()

    def end(self) -> None:
        """Saves the state, then writes what a resumed run cuts off again: last rows and a last checkpoint."""
        self.save()
        self._report_replay("ended")
        for actor in self._actors:
            actor.report("ended")
        self._learner.report("writing the last checkpoint")
        try:
            self._learner.save()
        except StorageError as error:
            _log.error("no last checkpoint: %s", error)

    def _report_replay(self, state: str) -> None:
        for name, value in self.store.metrics().items():
            self._replay_reporter.gauge(name, value)
        self._replay_reporter.send(state)

    def save(self) -> None:
        """Saves the state; where that fails the one before is kept, and the log says so."""
        self._save_due_s = self.now_s() + (self._config.replay.snapshot_period_s or float("inf"))
        try:
            write(self._run, self._num_turns, self._state(), self.store)
        except StorageError as error:
            _log.error("the state was not saved: %s; the one before is kept", error)

    def _parts(self) -> dict[str, Continuing]:
        """Returns everything with a state of its own but the replay, by name."""
        parts: dict[str, Continuing] = {
            "learner": self._learner,
            "source": self._source,
            "board": self._board,
            "replay": self._replay_reporter,
            "rows": self._reports.thinner,
        }
        for number, (actor, sink, look) in enumerate(zip(self._actors, self._sinks, self._looks, strict=True)):
            parts |= {f"actor-{number}": actor, f"sink-{number}": sink, f"look-{number}": look}
        if self._evaluator is not None:
            parts["evaluator"] = self._evaluator
        return parts

    def _state(self) -> State:
        values = {
            "num_turns": self._num_turns,
            "has_looked": self._has_looked,
            "wall_elapsed_s": self._reports.wall_elapsed_s,
        }
        own = State(values, {})
        return joined({"self": own} | {name: part.state() for name, part in self._parts().items()})

    def _restore(self, saved: SavedRun) -> None:
        values = saved.state.values["self"]
        self._num_turns, self._has_looked = values["num_turns"], values["has_looked"]
        for name, part in self._parts().items():
            if name in saved.state.values:  # an evaluator may be new
                part.restore(part_of(saved.state, name))

    def _assignment(self, role: Role) -> Assignment:
        never = threading.Event() if role.kind != "evaluator" else self._stop
        return Assignment(role, self._config, self._run, Addresses("", "", ""), never, 0, clock=self.now_s)

    def _reporter(self, assignment: Assignment) -> RoleReporter:
        return RoleReporter(assignment, resources=dict, line=self._reports)


@contextmanager
def _stopping(stop: threading.Event) -> Iterator[None]:
    """Makes Ctrl-C, SIGTERM and a closed terminal set an event, so that the turn is ended; a second one breaks off."""

    def handle(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    numbers = heeded("SIGINT", "SIGTERM", "SIGHUP")
    former = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
