"""RMSprop and Adam by torch's functions, with a state that is stored by parameter and name.

torch's optimiser classes do the same, but the first one made imports its compiler: 2 s of CPU and the memory of it, for
each learner that starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam
from torch.optim.rmsprop import rmsprop

from apex_bat.agent.inference import OPTIMISER
from apex_bat.config import settings

_ADAM_BETAS = (0.9, 0.999)  # Kingma & Ba (2015)


class Optimiser:
    """Steps along the gradients that the parameters hold."""

    def __init__(self, parameters: Sequence[Tensor], learner: settings.Learner) -> None:
        """Begins with moments of zero.

        Args:
            parameters: float32, of any shapes and on one device; each holds a gradient when `step` is called.
            learner: which optimiser, with its settings.
        """
        self._parameters, self._settings = list(parameters), learner
        averages = ["square_avg"] if learner.optimiser == "rmsprop" else ["exp_avg", "exp_avg_sq"]
        if learner.optimiser == "rmsprop" and learner.rmsprop_centred:
            averages.append("grad_avg")
        self._moments = {name: [torch.zeros_like(p, requires_grad=False) for p in parameters] for name in averages}
        self._steps = [torch.zeros(()) for _ in parameters]  # on the CPU, as torch keeps them

    @torch.no_grad()
    def step(self) -> None:
        """Changes the parameters by one step down their gradients."""
        learner, moments = self._settings, self._moments
        gradients = [p.grad for p in self._parameters if p.grad is not None]
        if learner.optimiser == "adam":
            adam(
                self._parameters, gradients, moments["exp_avg"], moments["exp_avg_sq"], [], self._steps,
                amsgrad=False, beta1=_ADAM_BETAS[0], beta2=_ADAM_BETAS[1], lr=learner.learning_rate,
                weight_decay=learner.weight_decay, eps=learner.epsilon, maximize=False,
            )  # fmt: skip
        else:
            rmsprop(
                self._parameters, gradients, moments["square_avg"], moments.get("grad_avg", []), [], self._steps,
                lr=learner.learning_rate, alpha=learner.rmsprop_decay, eps=learner.epsilon,
                weight_decay=learner.weight_decay, momentum=0.0, centered=learner.rmsprop_centred,
            )  # fmt: skip

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns copies of the state: float32, moments in the shapes of the parameters, counts of steps as scalars."""
        return {name: tensor.cpu().numpy().copy() for name, tensor in self._state().items()}

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Continues from what `arrays` returned; other names than those with the prefix may be among them.

        Raises:
            ValueError: the arrays are of another optimiser or of other parameters.
        """
        state = self._state()
        given = {name: array for name, array in arrays.items() if name.startswith(OPTIMISER)}
        if {name: tuple(tensor.shape) for name, tensor in state.items()} != {
            name: np.shape(array) for name, array in given.items()
        }:
            raise ValueError("the checkpoint's optimiser state does not fit this network")
        for name, tensor in state.items():
            tensor.copy_(torch.from_numpy(np.array(given[name])))

    def _state(self) -> dict[str, Tensor]:
        """Returns all tensors that change from step to step, by the names of their arrays."""
        tensors = {"step": self._steps} | self._moments
        return {
            f"{OPTIMISER}{number}/{key}": tensors[key][number]
            for number in range(len(self._parameters))
            for key in tensors
        }
