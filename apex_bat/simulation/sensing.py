"""From echo frames to what the policy sees: the three conditions of the thesis (section 3.2)."""

from __future__ import annotations

from typing import get_args

import numpy as np
from numpy.typing import NDArray

from apex_bat.config.settings import Condition, Sensing
from apex_bat.experience import NUM_BINS, NUM_EARS

CONDITIONS: tuple[str, ...] = get_args(Condition)


def keep_onsets(frames: NDArray[np.float32], settings: Sensing) -> NDArray[np.float32]:
    """Returns frames of which each row keeps only its first value above the threshold (condition onset).

    Args:
        frames: float32 (..., 24), rows of echo frames.
        settings: the threshold, and whether what follows the onset is zero or a copy of it (thesis fig. 3.11).
    """
    is_heard = frames > settings.onset_threshold
    first = is_heard.argmax(axis=-1)[..., None]
    value = np.where(is_heard.any(axis=-1, keepdims=True), np.take_along_axis(frames, first, axis=-1), 0.0)
    bins = np.arange(frames.shape[-1])
    kept = bins >= first if settings.onset == "copy" else bins == first
    return np.where(kept, value, 0.0).astype(np.float32)


def stack_echoes(history: NDArray[np.float32], condition: str) -> NDArray[np.float32]:
    """Returns the echo part of the state, a new array.

    Args:
        history: float32 (bats, memory_steps, 2, 24), the newest frame last, after the condition onset was applied.
        condition: `no_memory` blanks all frames but the newest.

    Returns:
        float32 (bats, 2 * memory_steps, 24), rows (oldest left, oldest right, ..., newest left, newest right).
    """
    echoes = history.copy()
    if condition == "no_memory":
        echoes[:, :-1] = 0.0
    return echoes.reshape(len(history), -1, NUM_BINS)


def silent_history(num_bats: int, settings: Sensing) -> NDArray[np.float32]:
    """Returns the memory of bats that have heard nothing yet: zeros (bats, memory_steps, 2, 24)."""
    return np.zeros((num_bats, settings.memory_steps, NUM_EARS, NUM_BINS), np.float32)
