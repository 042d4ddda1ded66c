"""Targets and losses of D3QN as pure functions of tensors (van Hasselt et al. 2016; Schaul et al. 2016)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional


def double_q_target(rewards: Tensor, discounts: Tensor, next_q_online: Tensor, next_q_target: Tensor) -> Tensor:
    """Returns R + discount * Q_target(s', argmax_a Q_online(s', a)), float32 (batch,), without gradient.

    Args:
        rewards: (batch,), n-step rewards R.
        discounts: (batch,), gamma^n, or 0 where the episode terminated.
        next_q_online: (batch, actions), the online network at s': it chooses.
        next_q_target: (batch, actions), the target network at s': it judges (double Q-learning).
    """
    chosen = next_q_online.argmax(dim=1, keepdim=True)
    return (rewards + discounts * next_q_target.gather(1, chosen).squeeze(1)).detach()


def td_errors(q: Tensor, actions: Tensor, targets: Tensor) -> Tensor:
    """Returns target - Q(s, a), float32 (batch,); q is (batch, actions), actions integers (batch,)."""
    return targets - q.gather(1, actions.long().unsqueeze(1)).squeeze(1)


def weighted_loss(errors: Tensor, weights: Tensor, kind: Literal["squared", "huber"]) -> Tensor:
    """Returns the mean over the batch of importance weight times loss of the TD error, a scalar.

    `squared` is error^2 / 2; `huber` is the same within +-1 and linear outside.
    """
    if kind == "squared":
        losses = 0.5 * errors.square()
    else:
        losses = functional.huber_loss(errors, torch.zeros_like(errors), reduction="none")
    return (weights * losses).mean()
