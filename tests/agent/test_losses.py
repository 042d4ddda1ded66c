"""Targets and losses against hand-worked numbers."""

import numpy as np
import pytest
import torch

from apex_bat.agent.losses import double_q_target, td_errors, weighted_loss


def test_online_network_chooses_and_target_network_judges() -> None:
    target = double_q_target(
        rewards=torch.tensor([1.0, 1.0]),
        discounts=torch.tensor([0.5, 0.0]),
        next_q_online=torch.tensor([[0.0, 9.0, 1.0], [9.0, 0.0, 0.0]]),
        next_q_target=torch.tensor([[7.0, 2.0, 8.0], [7.0, 0.0, 0.0]]),
    )
    np.testing.assert_allclose(target.numpy(), [1.0 + 0.5 * 2.0, 1.0])


def test_targets_carry_no_gradient() -> None:
    q = torch.ones(1, 3, requires_grad=True)
    assert not double_q_target(torch.zeros(1), torch.ones(1), q, q).requires_grad


def test_td_error_is_target_minus_value_of_the_taken_action() -> None:
    errors = td_errors(torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([2]), torch.tensor([5.0]))
    assert errors.item() == 2.0


@pytest.mark.parametrize(
    ("kind", "loss"), [("squared", (2.0 * 0.5 * 9.0 + 0.5 * 0.25) / 2), ("huber", (5.0 + 0.125) / 2)]
)
def test_loss_is_the_mean_of_weight_times_loss(kind: str, loss: float) -> None:
    errors, weights = torch.tensor([3.0, -0.5]), torch.tensor([2.0, 1.0])
    assert weighted_loss(errors, weights, kind).item() == pytest.approx(loss)  # type: ignore[arg-type]
