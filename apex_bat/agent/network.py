"""The dueling network of the bat (thesis fig. 3.8; dueling streams: Wang et al. 2016).

Filters of shape (1, 3) slide along each row of the state by itself, so that ears and calls meet only in the dense
layers, where the action memory joins them. `apex_bat.agent.inference` computes the same function without torch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from apex_bat.agent.inference import FILTER_BINS, num_bins_after
from apex_bat.config import settings
from apex_bat.experience import ACTION_MEMORY, NUM_ACTIONS, NUM_EARS


class Values(NamedTuple):
    """What the network says of a batch of states."""

    q: Tensor
    """float32 (batch, 3): expected discounted return of each action."""
    value: Tensor
    """float32 (batch, 1): the value stream V."""
    advantage: Tensor
    """float32 (batch, 3): the advantage stream A, before its mean or maximum is subtracted."""


class DuelingNetwork(nn.Module):
    """Q(s, a) = V(s) + A(s, a) - mean_a A (eq. A.4.6 of the thesis) or - max_a A (its eq. 3.2.8)."""

    def __init__(self, network: settings.Network, memory_steps: int) -> None:
        super().__init__()
        self.settings = network
        channels = (1, *network.channels)
        self.filters = nn.ModuleList(
            nn.Conv2d(channels[i], channels[i + 1], (1, FILTER_BINS), stride=(1, stride))
            for i, stride in enumerate(network.strides)
        )
        features = channels[-1] * NUM_EARS * memory_steps * num_bins_after(network)
        self.value = _stream(features + ACTION_MEMORY * NUM_ACTIONS, network, 1)
        self.advantage = _stream(features + ACTION_MEMORY * NUM_ACTIONS, network, NUM_ACTIONS)

    def forward(self, echoes: Tensor, actions: Tensor) -> Values:
        """Returns the values of states.

        Args:
            echoes: float32 (batch, 2 * memory_steps, 24).
            actions: uint8 or int64 (batch, 3), the last three actions.
        """
        x = echoes.unsqueeze(1) * self.settings.input_scale
        for convolution in self.filters:
            x = functional.relu(convolution(x))
        taken = functional.one_hot(actions.long(), NUM_ACTIONS).to(x.dtype)
        x = torch.cat((x.flatten(1), taken.flatten(1)), dim=1)
        value, advantage = self.value(x), self.advantage(x)
        if self.settings.dueling == "mean":
            baseline = advantage.mean(dim=1, keepdim=True)
        else:
            baseline = advantage.max(dim=1, keepdim=True).values
        return Values(value + advantage - baseline, value, advantage)


def parameters_of(network: nn.Module) -> dict[str, NDArray[np.float32]]:
    """Returns copies of all parameters by name, float32, as they travel to the actors."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in network.state_dict().items()}


def load_parameters(network: nn.Module, arrays: dict[str, NDArray[np.float32]]) -> None:
    """Overwrites all parameters of a network.

    Raises:
        ValueError: a name is missing or not known, or a shape differs: the arrays are of another network.
    """
    own = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    given = {name: array.shape for name, array in arrays.items()}
    if own != given:
        wrong = sorted(name for name in own.keys() | given.keys() if own.get(name) != given.get(name))
        raise ValueError(
            f"the weights are of another network: {wrong[0]} is {given.get(wrong[0])}, needed {own.get(wrong[0])}"
        )
    network.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})


def _stream(features: int, network: settings.Network, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for units in network.hidden:
        layers += [nn.Linear(features, units), nn.ReLU()]
        if network.dropout > 0.0:
            layers.append(nn.Dropout(network.dropout))
        features = units
    return nn.Sequential(*layers, nn.Linear(features, outputs))
