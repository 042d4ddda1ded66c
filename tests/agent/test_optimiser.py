"""The optimisers beside torch's own classes."""

import subprocess
import sys

import msgspec
import numpy as np
import pytest
import torch

from apex_bat.agent.optimiser import Optimiser
from apex_bat.config.settings import Learner

RMSPROP = Learner(learning_rate=0.01, rmsprop_decay=0.9, epsilon=0.001, weight_decay=0.1)
CENTRED = msgspec.structs.replace(RMSPROP, rmsprop_centred=True)
ADAM = msgspec.structs.replace(RMSPROP, optimiser="adam")
UPDATES_AN_AGENT = """
import sys
import numpy as np, torch
from apex_bat.agent.d3qn import D3QN
from apex_bat.config import Config
from apex_bat.experience import Batch, States
some = States(np.ones((4, 6, 24), np.float32), np.zeros((4, 3), np.uint8))
ones = np.ones(4, np.float32)
agent = D3QN(Config(), torch.device("cpu"))
agent.update(Batch(np.arange(4), ones, some, np.zeros(4, np.uint8), ones, ones, some))
print("torch._dynamo" in sys.modules)
"""


def parameters() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator).requires_grad_() for shape in ((5, 3), (4,), ())]


def give_gradients(tensors: list[torch.Tensor], step: int) -> None:
    generator = torch.Generator().manual_seed(step)
    for tensor in tensors:
        tensor.grad = torch.randn(tensor.shape, generator=generator)


def of_torch(tensors: list[torch.Tensor], learner: Learner) -> torch.optim.Optimizer:
    if learner.optimiser == "adam":
        return torch.optim.Adam(tensors, learner.learning_rate, eps=learner.epsilon, weight_decay=learner.weight_decay)
    return torch.optim.RMSprop(
        tensors, learner.learning_rate, alpha=learner.rmsprop_decay, eps=learner.epsilon,
        weight_decay=learner.weight_decay, centered=learner.rmsprop_centred,
    )  # fmt: skip


@pytest.mark.parametrize("learner", [RMSPROP, CENTRED, ADAM], ids=["rmsprop", "centred", "adam"])
def test_steps_and_state_are_those_of_torchs_class(learner: Learner) -> None:
    ours, theirs = parameters(), parameters()
    optimiser, twin = Optimiser(ours, learner), of_torch(theirs, learner)
    for step in range(20):
        give_gradients(ours, step)
        give_gradients(theirs, step)
        optimiser.step()
        twin.step()
    for own, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(own, other)
    expected = {
        f"optimiser/{number}/{key}": value.numpy()
        for number, state in twin.state_dict()["state"].items()
        for key, value in state.items()
    }
    found = optimiser.arrays()
    assert found.keys() == expected.keys()
    for name, array in found.items():
        np.testing.assert_allclose(array, expected[name], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("learner", [RMSPROP, CENTRED, ADAM], ids=["rmsprop", "centred", "adam"])
def test_a_restored_one_takes_the_same_steps_and_shares_no_memory(learner: Learner) -> None:
    originals = parameters()
    optimiser = Optimiser(originals, learner)
    give_gradients(originals, 0)
    optimiser.step()
    copies = [tensor.detach().clone().requires_grad_() for tensor in originals]
    restored, state = Optimiser(copies, learner), optimiser.arrays()
    restored.restore(state | {"online/value.0.weight": np.zeros(1, np.float32)})
    for array in state.values():
        array[...] = np.nan
    for step in range(1, 4):
        give_gradients(originals, step)
        give_gradients(copies, step)
        optimiser.step()
        restored.step()
    for own, other in zip(originals, copies, strict=True):
        assert torch.equal(own, other)


@pytest.mark.parametrize("other", ["adam", "centred", "fewer", "wider", "nothing"])
def test_a_state_of_something_else_is_refused_and_changes_nothing(other: str) -> None:
    optimiser = Optimiser(parameters(), RMSPROP)
    arrays = {
        "adam": Optimiser(parameters(), ADAM).arrays(),
        "centred": Optimiser(parameters(), CENTRED).arrays(),
        "fewer": Optimiser(parameters()[:2], RMSPROP).arrays(),
        "wider": Optimiser([torch.zeros(5, 4), *parameters()[1:]], RMSPROP).arrays(),
        "nothing": {},
    }[other]
    with pytest.raises(ValueError, match="optimiser state does not fit"):
        optimiser.restore({name: array + 1.0 for name, array in arrays.items()})
    assert not any(array.any() for array in optimiser.arrays().values())


def test_an_update_does_not_import_torchs_compiler() -> None:
    ran = subprocess.run([sys.executable, "-c", UPDATES_AN_AGENT], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"
