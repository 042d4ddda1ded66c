"""The dueling network in numpy, for actors and evaluators: no autograd, no torch import, faster at small batches.

`apex_bat.agent.network.DuelingNetwork` is the definition; a test holds both to the same values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from apex_bat.config import settings
from apex_bat.experience import ACTION_MEMORY, NUM_ACTIONS, NUM_BINS, NUM_EARS, States

Array = NDArray[np.float32]
FILTER_BINS = 3
ONLINE, TARGET, AVERAGE = "online/", "target/", "average/"  # before the names of parameters in a learner's arrays
OPTIMISER = "optimiser/"  # before PARAMETER/KEY there: the parameter by its number, the key as torch calls it
NETWORK_STREAM = 4  # beside the run's seed, for a random stream that is no role's


class PolicyValues(NamedTuple):
    """What the network says of a batch of states."""

    q: Array
    """(batch, 3): expected discounted return of each action."""
    value: Array
    """(batch, 1): the value stream."""
    advantage: Array
    """(batch, 3): the advantage stream, before its mean or maximum is subtracted."""


class Policy:
    """A network whose parameters can be exchanged while it flies."""

    def __init__(self, network: settings.Network, memory_steps: int) -> None:
        self._settings = network
        self._shapes = parameter_shapes(network, memory_steps)
        self._memory_steps = memory_steps
        self._filters: list[tuple[Array, Array, int]] = []
        self._streams: list[list[tuple[Array, Array]]] = []

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of each parameter, as the learner broadcasts them."""
        return self._shapes

    def load(self, arrays: dict[str, Array]) -> None:
        """Takes up new parameters.

        Raises:
            ValueError: they are not those of this network.
        """
        given = {name: array.shape for name, array in arrays.items()}
        if given != self._shapes:
            wrong = sorted(n for n in given.keys() | self._shapes.keys() if given.get(n) != self._shapes.get(n))
            raise ValueError(
                f"the weights are of another network: {wrong[0]} is {given.get(wrong[0])}, "
                f"needed {self._shapes.get(wrong[0])}"
            )
        self._filters = []
        for i, stride in enumerate(self._settings.strides):
            kernel = arrays[f"filters.{i}.weight"]  # (out, in, 1, 3), used as (in * 3, out)
            flat = np.ascontiguousarray(kernel.reshape(kernel.shape[0], -1).T)
            self._filters.append((flat, arrays[f"filters.{i}.bias"], stride))
        self._streams = [self._stream(name, arrays) for name in ("value", "advantage")]

    def __call__(self, states: States) -> PolicyValues:
        """Returns the values of a batch of states."""
        x = states.echoes[..., None] * np.float32(self._settings.input_scale)  # (batch, rows, bins, channels)
        for kernel, bias, stride in self._filters:
            windows = sliding_window_view(x, FILTER_BINS, axis=2)[:, :, ::stride]  # (batch, rows, bins, channels, 3)
            x = windows.reshape(*windows.shape[:3], -1) @ kernel
            x += bias
            np.maximum(x, 0.0, out=x)
        taken = np.eye(NUM_ACTIONS, dtype=np.float32)[states.actions].reshape(len(states.actions), -1)
        x = np.concatenate((x.reshape(len(x), -1), taken), axis=1)
        value, advantage = (_dense(x, stream) for stream in self._streams)
        if self._settings.dueling == "mean":
            baseline = advantage.mean(axis=1, keepdims=True)
        else:
            baseline = advantage.max(axis=1, keepdims=True)
        return PolicyValues(value + advantage - baseline, value, advantage)

    def _stream(self, name: str, arrays: dict[str, Array]) -> list[tuple[Array, Array]]:
        prefix = f"{name}."
        numbers = sorted({int(key.split(".")[1]) for key in arrays if key.startswith(prefix)})
        layers = [(arrays[f"{prefix}{n}.weight"].T.copy(), arrays[f"{prefix}{n}.bias"]) for n in numbers]
        # torch flattens (channels, rows, bins); here the channels come last, so the first layer's inputs are reordered.
        weight, bias = layers[0]
        memory = ACTION_MEMORY * NUM_ACTIONS
        rows, channels = NUM_EARS * self._memory_steps, self._settings.channels[-1]
        echo = weight[:-memory].reshape(channels, rows, -1, weight.shape[1]).transpose(1, 2, 0, 3)
        layers[0] = (np.concatenate((echo.reshape(-1, weight.shape[1]), weight[-memory:])), bias)
        return layers


def num_bins_after(network: settings.Network) -> int:
    """Returns how many values the filters leave of a row of 24.

    Raises:
        ValueError: the filters and strides leave none.
    """
    width = NUM_BINS
    for stride in network.strides:
        width = (width - FILTER_BINS) // stride + 1
        if width < 1:
            raise ValueError(f"network.strides {network.strides} leave nothing of a row of {NUM_BINS} values")
    return width


def parameter_shapes(network: settings.Network, memory_steps: int) -> dict[str, tuple[int, ...]]:
    """Returns name and shape of each parameter of the network, in torch's order and notation.

    Raises:
        ValueError: the filters and strides leave nothing of an echo row.
    """
    shapes: dict[str, tuple[int, ...]] = {}
    channels, width = (1, *network.channels), num_bins_after(network)
    for i in range(len(network.strides)):
        shapes[f"filters.{i}.weight"] = (channels[i + 1], channels[i], 1, FILTER_BINS)
        shapes[f"filters.{i}.bias"] = (channels[i + 1],)
    layers_apart = 3 if network.dropout > 0.0 else 2  # linear, ReLU and perhaps dropout
    for name, outputs in (("value", 1), ("advantage", NUM_ACTIONS)):
        inputs = channels[-1] * NUM_EARS * memory_steps * width + ACTION_MEMORY * NUM_ACTIONS
        for i, units in enumerate((*network.hidden, outputs)):
            shapes[f"{name}.{i * layers_apart}.weight"] = (units, inputs)
            shapes[f"{name}.{i * layers_apart}.bias"] = (units,)
            inputs = units
    return shapes


def initial_parameters(network: settings.Network, memory_steps: int, seed: int) -> dict[str, Array]:
    """Returns the parameters that a run begins with: whoever knows its settings has them, before there is a learner.

    Weights and biases are uniform within 1 / sqrt(inputs of the layer), as torch draws them.
    """
    generator = np.random.default_rng([seed, NETWORK_STREAM])
    parameters: dict[str, Array] = {}
    bound = 0.0
    for name, shape in parameter_shapes(network, memory_steps).items():
        if name.endswith(".weight"):  # the bias follows its weights
            bound = 1.0 / math.sqrt(math.prod(shape[1:]))
        parameters[name] = generator.uniform(-bound, bound, shape).astype(np.float32)
    return parameters


def parameters_under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Array]:
    """Returns the parameters of one network of a learner's arrays by name, without the prefix."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def policy_parameters(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Array]:
    """Returns the parameters to fly with: the averaged ones, or the online network's without an average."""
    return parameters_under(AVERAGE, arrays) or parameters_under(ONLINE, arrays)


def part_norms(parameters: Mapping[str, Array]) -> dict[str, float]:
    """Returns `weights_norm.PART` of each part of the network: the root of the sum of its squared parameters."""
    squares: dict[str, float] = {}
    for name, values in parameters.items():
        part = f"weights_norm.{name.partition('.')[0]}"
        squares[part] = squares.get(part, 0.0) + float(np.square(values, dtype=np.float64).sum())
    return {part: math.sqrt(total) for part, total in squares.items()}


def _dense(x: Array, layers: list[tuple[Array, Array]]) -> Array:
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight + bias
        if i < len(layers) - 1:
            np.maximum(x, 0.0, out=x)
    return x
