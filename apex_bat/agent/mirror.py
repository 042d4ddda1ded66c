"""The mirror symmetry of a bat: left and right ear swapped, and left and right turns with them.

What is true of a flight is true of its mirror image: body, call, ears and rewards know no side. So each transition also
teaches what it would have been in the mirrored arena, and one that was learnt from both sides turns as well to the left
as to the right (the image-flip augmentation of Yarats et al. 2021, for two ears).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import NUM_ACTIONS, NUM_EARS, Batch, States

_MIRRORED_ACTION = np.arange(NUM_ACTIONS, dtype=np.uint8)
_MIRRORED_ACTION[1:] = _MIRRORED_ACTION[:0:-1]


def mirror_states(states: States, rows: NDArray[np.bool_]) -> States:
    """Returns states of which some rows, bool (batch,), are mirrored; the given arrays stay as they are."""
    echoes, actions = states.echoes.copy(), states.actions.copy()
    pairs = echoes.reshape(len(echoes), -1, NUM_EARS, echoes.shape[-1])
    pairs[rows] = pairs[rows, :, ::-1]
    actions[rows] = _MIRRORED_ACTION[actions[rows]]
    return States(echoes, actions)


def mirror_batch(batch: Batch, rows: NDArray[np.bool_]) -> Batch:
    """Returns a batch of which some transitions, bool (batch,), are mirrored: states, actions and next states."""
    actions = batch.actions.copy()
    actions[rows] = _MIRRORED_ACTION[actions[rows]]
    return batch._replace(
        states=mirror_states(batch.states, rows),
        actions=actions,
        next_states=mirror_states(batch.next_states, rows),
    )
