"""The learning agent: dueling double deep Q-network with importance-weighted n-step updates.

Ingredients: dueling streams (Wang et al. 2016), double Q-learning (van Hasselt et al. 2016), prioritized replay with
importance weights (Schaul et al. 2016), n-step targets, (centred) RMSprop and a clipped gradient (Horgan et al. 2018).
The policy that is handed out is an average of the online network (Polyak & Juditsky 1992; of deep networks, Izmailov et
al. 2018): single updates still change what is done in rare states when all common ones are learnt.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_bat.agent.inference import (
    AVERAGE,
    ONLINE,
    TARGET,
    initial_parameters,
    parameters_under,
    policy_parameters,
)
from apex_bat.agent.losses import double_q_target, td_errors, weighted_loss
from apex_bat.agent.mirror import mirror_batch
from apex_bat.agent.network import DuelingNetwork, Values, load_parameters, parameters_of
from apex_bat.agent.optimiser import Optimiser
from apex_bat.config import Config
from apex_bat.experience import Batch

AVERAGED_SHARE = 0.1  # of the updates so far, at most: what was learnt first does not burden the average for long


class Update(NamedTuple):
    """What one update did."""

    errors: NDArray[np.float32]
    """(batch,): TD errors before the update; their sizes are the new priorities."""
    loss: float
    """Mean weighted loss."""
    gradient_norm: float
    """Global norm of the gradient before clipping."""
    q_mean: float
    """Mean of Q(s, a) over the batch."""


class D3QN:
    """Online and target network with their optimiser, the average of the online one, and the count of updates."""

    def __init__(self, config: Config, device: torch.device) -> None:
        """Makes all networks equal, with the parameters that the seed gives; dropout draws from torch's generator."""
        self._settings = config.learner
        self.device = device
        self.online = DuelingNetwork(config.network, config.state_steps).to(device)
        load_parameters(self.online, initial_parameters(config.network, config.state_steps, config.seed))
        self.target = DuelingNetwork(config.network, config.state_steps).to(device)
        self.target.load_state_dict(self.online.state_dict())
        self.target.requires_grad_(False).eval()  # dropout is for learning: no noise in targets
        self.average = deepcopy(self.target) if config.learner.averaged_updates else None
        self.optimiser = Optimiser(list(self.online.parameters()), config.learner)
        self.num_updates = 0
        self._values: tuple[Callable[..., Values], Callable[..., Values]] = (self.online, self.target)
        if config.learner.compile:
            self._values = (torch.compile(self.online), torch.compile(self.target))

    def update(self, batch: Batch) -> Update:
        """Takes one step of gradient descent on a batch and copies the target network when its time has come."""
        if self._settings.mirror:  # every other transition, the other ones at the next update: no random state to keep
            batch = mirror_batch(batch, (np.arange(len(batch.actions)) + self.num_updates) % 2 == 1)
        online, target = self._values
        states = [self._moved(array) for array in batch.states]
        next_states = [self._moved(array) for array in batch.next_states]
        rewards, discounts, weights, actions = (
            self._moved(array) for array in (batch.rewards, batch.discounts, batch.weights, batch.actions)
        )
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._settings.precision == "bfloat16"):
            self.online.eval()
            with torch.no_grad():
                next_q_online, next_q_target = online(*next_states).q.float(), target(*next_states).q.float()
            self.online.train()
            q = online(*states).q.float()
        errors = td_errors(q, actions, double_q_target(rewards, discounts, next_q_online, next_q_target))
        loss = weighted_loss(errors, weights, self._settings.loss)
        self.online.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        limit = self._settings.gradient_clip if self._settings.gradient_clip > 0.0 else float("inf")
        norm = torch.nn.utils.clip_grad_norm_(self.online.parameters(), limit)
        self.optimiser.step()
        self.num_updates += 1
        self._follow()
        self._take_average()
        return Update(errors.detach().cpu().numpy(), float(loss.detach()), float(norm), float(q.detach().mean()))

    def weights(self) -> dict[str, NDArray[np.float32]]:
        """Returns copies of the online network's parameters by name."""
        return parameters_of(self.online)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns everything that learning continues from: the networks and the optimiser's state, by name."""
        arrays: dict[str, NDArray[Any]] = {}
        for prefix, network in self._networks().items():
            arrays |= {prefix + name: array for name, array in parameters_of(network).items()}
        return arrays | self.optimiser.arrays()

    def restore(self, arrays: dict[str, NDArray[Any]], num_updates: int) -> None:
        """Continues from what `arrays` returned; an average that they lack begins anew from the online network.

        Raises:
            ValueError: the arrays are of another network or another optimiser.
        """
        for prefix, network in self._networks().items():
            given = policy_parameters(arrays) if prefix == AVERAGE else parameters_under(prefix, arrays)
            load_parameters(network, given)
        if num_updates:  # before the first, all moments are zero, and older checkpoints hold none
            self.optimiser.restore(arrays)
        self.num_updates = num_updates

    def _moved(self, array: NDArray[Any]) -> Tensor:
        """Returns an array on the device; to CUDA through pinned memory, so that the copy does not wait."""
        tensor = torch.from_numpy(array)
        if self.device.type == "cuda":
            return tensor.pin_memory().to(self.device, non_blocking=True)
        return tensor

    def _networks(self) -> dict[str, DuelingNetwork]:
        """Returns all networks by the prefix of their parameters' names."""
        networks = {ONLINE: self.online, TARGET: self.target}
        return networks if self.average is None else networks | {AVERAGE: self.average}

    def _follow(self) -> None:
        period, tau = self._settings.target_period, self._settings.target_tau
        if period == 0:
            _approach(self.target, self.online, tau)
        elif self.num_updates % period == 0:
            self.target.load_state_dict(self.online.state_dict())

    def _take_average(self) -> None:
        """Averages over `averaged_updates`, exponentially; at first over as large a share of the updates so far."""
        if self.average is not None:
            updates = min(self._settings.averaged_updates, max(AVERAGED_SHARE * self.num_updates, 1.0))
            _approach(self.average, self.online, 1.0 / updates)


def _approach(slow: DuelingNetwork, fast: DuelingNetwork, share: float) -> None:
    """Moves the parameters of one network towards those of another, by a share of the difference."""
    with torch.no_grad():
        for moved, goal in zip(slow.parameters(), fast.parameters(), strict=True):
            moved.lerp_(goal, share)
