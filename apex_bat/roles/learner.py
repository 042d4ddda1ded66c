"""The learner: samples, updates the D3QN, sends priorities back, broadcasts weights and writes checkpoints."""

from __future__ import annotations

import logging
from contextlib import ExitStack, closing

import numpy as np
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.agent.inference import part_norms
from apex_bat.config import ConfigError
from apex_bat.replay.client import ReplayReader
from apex_bat.roles import checkpoint
from apex_bat.roles.checkpoint import Checkpoint
from apex_bat.roles.lines import BatchSource, WeightsSink
from apex_bat.roles.plan import Assignment
from apex_bat.roles.reporting import Phases, RoleReporter
from apex_bat.storage import State, StorageError, joined, part_of
from apex_bat.transport.refusals import PUBLISHER_REASONS
from apex_bat.transport.weights import WeightsPublisher

_log = logging.getLogger(__name__)
_WAIT_S = 0.2


def run_learner(assignment: Assignment) -> None:
    """Learns until told to stop or until `train.max_updates`, and writes a last checkpoint."""
    config, addresses, keys = assignment.config, assignment.addresses, assignment.keys()
    agent, version = make_agent(assignment)
    with ExitStack() as stack:
        publisher = stack.enter_context(
            closing(WeightsPublisher(addresses.weights, keys=keys, generation=addresses.weights_generation))
        )
        reader = stack.enter_context(
            closing(
                ReplayReader(
                    addresses.replays, config.learner.batch_size, config.learner.prefetch,
                    learner_step=agent.num_updates, keys=keys, generation=addresses.replay_generations,
                    max_message_bytes=config.transport.max_message_bytes, generator=assignment.generator(),
                )
            )
        )  # fmt: skip
        reporter = stack.enter_context(closing(RoleReporter(assignment, addresses.weights)))
        learner = Learner(assignment, agent, version, reader, publisher, reporter)
        has_learnt = False
        while not (assignment.stop.is_set() or learner.is_done):
            if (moved := assignment.moved()) is not None:
                reader.redirect(moved.replays, moved.replay_generations)
            if learner.step(_WAIT_S) and not has_learnt:
                has_learnt = True
                _log.info("begins to learn")
            reporter.gauge("weights.subscribers", publisher.num_subscribers)
            for reason in PUBLISHER_REASONS:
                reporter.gauge(f"weights.refused.{reason}", publisher.refusals.counts.get(reason, 0))
        learner.report("writing the last checkpoint")
        try:
            learner.save()
        except StorageError as error:  # of a full disk: the one before is the last, and the run has ended as asked
            _log.error("no last checkpoint: %s", error)


def make_agent(assignment: Assignment) -> tuple[D3QN, int]:
    """Returns the agent and the version of its weights, continued from the run's newest checkpoint if there is one.

    Raises:
        StorageError: there are checkpoints, and none can be read.
        ConfigError: the newest is of another network or other sensing than the settings say.
    """
    config = assignment.config
    agent = new_agent(assignment)
    folder = assignment.run / "checkpoints"
    found = checkpoint.load_newest(folder)
    if found is None:
        return agent, 0
    if found.fingerprint != checkpoint.fingerprint(config):
        raise ConfigError(f"{folder}: the newest checkpoint is of another network, sensing or condition")
    checkpoint.set_torn_aside(folder, found)
    agent.restore(found.arrays, found.learner_step)
    _restore_random_state(found.counters["torch_random"])
    _log.info("continues from the checkpoint of update %d", found.learner_step)
    return agent, int(found.counters["weights_version"])


def new_agent(assignment: Assignment) -> D3QN:
    """Returns an agent that has learned nothing yet; seeds torch's generator, from which dropout draws."""
    config = assignment.config
    torch.set_num_threads(config.train.threads)
    torch.manual_seed(config.seed)
    return D3QN(config, device_of(config.device))


class Learner:
    """The state of the learner: the agent, and when what is due."""

    def __init__(
        self,
        assignment: Assignment,
        agent: D3QN,
        version: int,
        reader: BatchSource,
        publisher: WeightsSink,
        reporter: RoleReporter,
    ) -> None:
        """Broadcasts the agent's weights at once; `version` is that of the last ones broadcast in this run."""
        self._config, self._folder = assignment.config, assignment.run / "checkpoints"
        self._agent, self._version = agent, version
        self._reader, self._publisher, self._reporter = reader, publisher, reporter
        self._clock = assignment.clock
        self._phases = Phases("waiting", "update", "weights", "checkpoint", clock=self._clock)
        self._checkpoint_due_s = self._clock() + self._config.checkpoint.period_s
        self._broadcast()

    @property
    def num_updates(self) -> int:
        """Updates made in the whole run."""
        return self._agent.num_updates

    @property
    def is_done(self) -> bool:
        """Whether `train.max_updates` is reached."""
        limit = self._config.train.max_updates
        return limit is not None and self._agent.num_updates >= limit

    def step(self, timeout_s: float) -> bool:
        """Waits for a batch, at most so long, and makes one update; says whether it did."""
        self._publisher.serve()
        with self._phases.of("waiting"):
            batch = self._reader.next(timeout_s)
        if batch is not None:
            with self._phases.of("update"):
                update = self._agent.update(batch)
            self._reader.update(batch.items, np.abs(update.errors))
            self._reporter.count("updates", 1)
            self._reporter.average("loss", update.loss)
            self._reporter.average("gradient_norm", update.gradient_norm)
            self._reporter.average("q_mean", update.q_mean)
            if self._agent.num_updates % self._config.learner.weights_period == 0:
                self._broadcast()
        if self._clock() >= self._checkpoint_due_s:
            self._try_save()
        if self._reporter.is_due:
            self.report("learning" if batch is not None else self._reader.waiting)
        return batch is not None

    def report(self, state: str) -> None:
        """Reports what the learner does, and its figures."""
        self._reporter.gauge("learner_step", self._agent.num_updates)
        self._reporter.gauge("weights_version", self._version)
        for name, value in (self._reader.counters() | part_norms(self._agent.weights())).items():
            self._reporter.gauge(name, value)
        self._reporter.send(state, self._phases)

    def save(self) -> None:
        """Writes a checkpoint.

        Raises:
            StorageError: it could not be written; older ones are untouched.
        """
        counters = {"weights_version": self._version, "torch_random": _random_state()}
        state = Checkpoint(
            self._agent.num_updates, checkpoint.fingerprint(self._config), counters, self._agent.arrays()
        )
        checkpoint.save(self._folder, state, self._config.checkpoint.keep)

    def state(self) -> State:
        """Returns all that the learner continues from, for `restore`."""
        values = {
            "num_updates": self._agent.num_updates,
            "weights_version": self._version,
            "torch_random": _random_state(),
            "checkpoint_due_s": self._checkpoint_due_s,
        }
        return joined({"self": State(values, self._agent.arrays()), "reporter": self._reporter.state()})

    def restore(self, state: State) -> None:
        """Continues from what `state` returned; broadcasts nothing.

        Raises:
            ValueError: the state is of another network or optimiser.
        """
        values, arrays = part_of(state, "self")
        self._agent.restore(arrays, values["num_updates"])
        self._version, self._checkpoint_due_s = values["weights_version"], values["checkpoint_due_s"]
        _restore_random_state(values["torch_random"])
        self._reporter.restore(part_of(state, "reporter"))

    def _try_save(self) -> None:
        with self._phases.of("checkpoint"):
            try:
                self.save()
            except StorageError as error:
                _log.error(
                    "no checkpoint: %s; training goes on, and the next attempt is in %g s",
                    error,
                    self._config.checkpoint.period_s,
                )
        self._checkpoint_due_s = self._clock() + self._config.checkpoint.period_s

    def _broadcast(self) -> None:
        with self._phases.of("weights"):
            self._version += 1
            self._publisher.publish(self._version, self._agent.num_updates, self._agent.weights())


def device_of(name: str) -> torch.device:
    """Returns the torch device of the setting `device`.

    Raises:
        ConfigError: CUDA is asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device is cuda, and torch finds none; set device=auto or device=cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _random_state() -> str:
    """Returns the state of torch's generator, from which dropout draws on a CPU, in hexadecimal digits."""
    return torch.get_rng_state().numpy().tobytes().hex()


def _restore_random_state(digits: str) -> None:
    torch.set_rng_state(torch.from_numpy(np.frombuffer(bytes.fromhex(digits), np.uint8).copy()))
