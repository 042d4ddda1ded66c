"""The learner: samples, updates the D3QN, sends priorities back, broadcasts weights and writes checkpoints."""

from __future__ import annotations

import logging
import time

import numpy as np
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.config import ConfigError
from apex_bat.replay.client import ReplayReader
from apex_bat.roles import checkpoint
from apex_bat.roles.checkpoint import Checkpoint
from apex_bat.roles.plan import Assignment
from apex_bat.roles.reporting import Phases, RoleReporter
from apex_bat.storage import StorageError
from apex_bat.transport.weights import WeightsPublisher

_log = logging.getLogger(__name__)
_WAIT_S = 0.2


def run_learner(assignment: Assignment) -> None:
    """Learns until told to stop or until `train.max_updates`, and writes a last checkpoint."""
    learner = Learner(assignment)
    try:
        while not (assignment.stop.is_set() or learner.is_done):
            learner.step(_WAIT_S)
        learner.save()
    finally:
        learner.close()


class Learner:
    """The state of the learner: agent, line to the replay, broadcaster of weights."""

    def __init__(self, assignment: Assignment) -> None:
        """Continues from the newest checkpoint of the run folder, if there is one.

        Raises:
            StorageError: there are checkpoints, and none can be read.
            ConfigError: the newest is of another network or other sensing than the settings say.
        """
        config = assignment.config
        self._config = config
        self._folder = assignment.run / "checkpoints"
        torch.set_num_threads(config.train.threads)
        torch.manual_seed(config.seed)
        self._agent = D3QN(config, device_of(config.device))
        self._version = 0
        self._restore(checkpoint.load_newest(self._folder))
        keys = assignment.keys()
        self._publisher = WeightsPublisher(assignment.addresses.weights, keys=keys)
        self._reader = ReplayReader(
            assignment.addresses.replay, config.learner.batch_size, config.learner.prefetch,
            learner_step=self._agent.num_updates, keys=keys, max_message_bytes=config.transport.max_message_bytes,
        )  # fmt: skip
        self._reporter = RoleReporter(assignment, assignment.addresses.weights)
        self._phases = Phases("waiting", "update", "weights", "checkpoint")
        self._checkpoint_due_s = time.monotonic() + config.checkpoint.period_s
        self._broadcast()

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
        if time.monotonic() >= self._checkpoint_due_s:
            self._try_save()
        if self._reporter.is_due:
            self._reporter.gauge("learner_step", self._agent.num_updates)
            self._reporter.gauge("weights_version", self._version)
            for name, value in self._reader.counters().items():
                self._reporter.gauge(name, value)
            self._reporter.send("learning" if batch is not None else self._reader.waiting, self._phases)
        return batch is not None

    def save(self) -> None:
        """Writes a checkpoint.

        Raises:
            StorageError: it could not be written; older ones are untouched.
        """
        counters = {"weights_version": self._version, "torch_random": torch.get_rng_state().numpy().tobytes().hex()}
        state = Checkpoint(
            self._agent.num_updates, checkpoint.fingerprint(self._config), counters, self._agent.arrays()
        )
        checkpoint.save(self._folder, state, self._config.checkpoint.keep)

    def close(self) -> None:
        """Ends the reader's thread and closes the sockets."""
        self._reader.close()
        self._publisher.close()
        self._reporter.close()

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
        self._checkpoint_due_s = time.monotonic() + self._config.checkpoint.period_s

    def _broadcast(self) -> None:
        with self._phases.of("weights"):
            self._version += 1
            self._publisher.publish(self._version, self._agent.num_updates, self._agent.weights())

    def _restore(self, found: Checkpoint | None) -> None:
        if found is None:
            return
        if found.fingerprint != checkpoint.fingerprint(self._config):
            raise ConfigError(f"{self._folder}: the newest checkpoint is of another network, sensing or condition")
        self._agent.restore(found.arrays, found.learner_step)
        self._version = int(found.counters["weights_version"])
        state = np.frombuffer(bytes.fromhex(found.counters["torch_random"]), np.uint8).copy()
        torch.set_rng_state(torch.from_numpy(state))
        _log.info("continues from the checkpoint of update %d", found.learner_step)


def device_of(name: str) -> torch.device:
    """Returns the torch device of the setting `device`.

    Raises:
        ConfigError: CUDA is asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device is cuda, and torch finds none; set device=auto or device=cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
