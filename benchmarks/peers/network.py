"""The network of all: apex_bat's convolutions and streams as torch modules of flat observations.

A library that knows dueling streams gets the whole network; one that does not gets the same convolutions and one stream
of twice the width, which has as many parameters.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from apex_bat.agent.network import DuelingNetwork
from apex_bat.config import Config
from apex_bat.experience import ACTION_MEMORY, NUM_ACTIONS, NUM_BINS


class Features(nn.Module):
    """The convolved echoes and the last actions, joined: what the dense layers see. float32 (batch, width)."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        network = DuelingNetwork(config.network, config.state_steps)
        self.filters = network.filters
        self.width = first_layer(network.value).in_features
        self._input_scale = config.network.input_scale

    def forward(self, flat: Tensor) -> Tensor:
        """Returns the features of flat observations, float32 (batch, values)."""
        echoes, actions = flat[:, :-ACTION_MEMORY], flat[:, -ACTION_MEMORY:]
        x = echoes.reshape(len(flat), 1, -1, NUM_BINS) * self._input_scale
        for convolution in self.filters:
            x = functional.relu(convolution(x))
        taken = functional.one_hot(actions.long(), NUM_ACTIONS).to(x.dtype)
        return torch.cat((x.flatten(1), taken.flatten(1)), dim=1)


class FlatDueling(nn.Module):
    """The whole dueling network of flat observations."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.features = Features(config)
        network = DuelingNetwork(config.network, config.state_steps)
        self.value, self.advantage = network.value, network.advantage

    def forward(self, flat: Tensor) -> Tensor:
        """Returns Q, float32 (batch, 3); the mean of the advantages is subtracted."""
        x = self.features(flat)
        advantage = self.advantage(x)
        return torch.as_tensor(self.value(x) + advantage - advantage.mean(dim=1, keepdim=True))


def single_width(config: Config) -> int:
    """Returns the width of one stream with as many parameters as two streams of the settings' width."""
    return 2 * config.network.hidden[0]


def named(
    features: Features, advantage: nn.Sequential, value: nn.Sequential | None = None
) -> dict[str, NDArray[np.float32]]:
    """Returns copies of a network's parameters by the names of `apex_bat.agent.inference`.

    Args:
        features: the convolutions.
        advantage: the advantages, or, without a value stream, the Q values themselves.
        value: the value stream; None: it is filled with zeros, which leaves the order of the Q values as it is.
    """
    parts: dict[str, nn.Module] = {"filters": features.filters, "advantage": advantage}
    arrays = {
        f"{part}.{name}": tensor.detach().cpu().numpy().copy()
        for part, module in parts.items()
        for name, tensor in module.state_dict().items()
    }
    if value is not None:
        return arrays | {f"value.{k}": v.detach().cpu().numpy().copy() for k, v in value.state_dict().items()}
    zeros = {
        name.replace("advantage", "value"): np.zeros_like(array)
        for name, array in arrays.items()
        if name.startswith("advantage.")
    }
    last = max(int(name.split(".")[1]) for name in zeros)
    for name in (f"value.{last}.weight", f"value.{last}.bias"):
        zeros[name] = zeros[name][:1]
    return arrays | zeros


def first_layer(stream: nn.Module) -> nn.Linear:
    """Returns the first dense layer of a stream."""
    return next(layer for layer in stream.modules() if isinstance(layer, nn.Linear))
