"""The arrays of each kind of message: which, in which order, and what their values must be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import ACTION_MEMORY, NO_ACTION, NUM_ACTIONS, NUM_BINS, NUM_EARS, Batch, Chunk, States
from apex_bat.transport.framing import ArraySpec, MessageError, unpack
from apex_bat.transport.kinds import (
    Headers,
    Insert,
    InsertHeader,
    Message,
    PriorityHeader,
    PriorityUpdate,
    Report,
    Sample,
    SampleHeader,
    Weights,
    WeightsHeader,
)

LARGEST = 1e9  # a greater magnitude in any float is a fault: its square leaves the range of float32 sums


def taken_apart(message: Message) -> tuple[Headers, Sequence[NDArray[Any]], list[ArraySpec]]:
    """Returns header, arrays and the specification that these must meet."""
    match message:
        case Insert():
            header = _insert_header(message)
            return header, [_joined(message.chunks, field) for field in _CHUNK_ORDER], _insert_specs(header)
        case Sample(request, batch, standing):
            size, num_rows, _ = batch.states.echoes.shape
            sample = SampleHeader(request, size, num_rows // NUM_EARS, standing)
            arrays: list[NDArray[Any]] = [
                batch.items,
                batch.weights,
                batch.rewards,
                batch.discounts,
                batch.states.echoes,
            ]
            arrays += [batch.next_states.echoes, batch.states.actions, batch.next_states.actions, batch.actions]
            return sample, arrays, _sample_specs(sample)
        case PriorityUpdate(learner_step, items, priorities):
            update = PriorityHeader(learner_step, len(items))
            return update, [items, priorities], _priority_specs(update)
        case Weights(version, learner_step, named):
            shapes = tuple(array.shape for array in named.values())
            weights = WeightsHeader(version, learner_step, tuple(named), shapes)
            return weights, list(named.values()), [(np.float32, shape) for shape in shapes]
        case _:
            return message, [], []


def put_together(header: Headers, body: memoryview) -> Message:
    """Returns the message of a header and a body; raises MessageError if its shapes or values are wrong."""
    match header:
        case InsertHeader():
            return _insert(header, body)
        case SampleHeader():
            return _sample(header, body)
        case PriorityHeader():
            items, priorities = unpack(body, _priority_specs(header))
            _check("items", items, 0, 2**62)
            _check("priorities", priorities, -LARGEST, LARGEST)
            return PriorityUpdate(header.learner_step, items, priorities)
        case WeightsHeader():
            return _weights(header, body)
        case Report():
            unpack(body, [])
            if not np.isfinite(list(header.metrics.values())).all():
                raise MessageError("value", "a metric is not finite")
            return header
        case _:
            unpack(body, [])
            return header


# Inserts. The arrays of all chunks of a message are joined field by field: one check and one copy for all of them.

_CHUNK_ORDER = ("frames", "rewards", "discounts", "priorities", "starts", "actions", "spans")


def _joined(chunks: Sequence[Chunk], field: str) -> NDArray[np.generic]:
    arrays = [getattr(chunk, field) for chunk in chunks]
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _insert_header(message: Insert) -> InsertHeader:
    return InsertHeader(
        message.actor,
        message.incarnation,
        message.sequence,
        message.first_unacknowledged,
        message.learner_step,
        tuple(chunk.first_step for chunk in message.chunks),
        tuple(len(chunk.frames) for chunk in message.chunks),
        tuple(len(chunk.starts) for chunk in message.chunks),
    )


def _insert_specs(header: InsertHeader) -> list[ArraySpec]:
    rows, transitions = sum(header.rows), sum(header.transitions)
    floats: list[ArraySpec] = [(np.float32, (rows, NUM_EARS, NUM_BINS)), *[(np.float32, (transitions,))] * 3]
    return [*floats, (np.uint16, (transitions,)), (np.uint8, (rows,)), (np.uint8, (transitions,))]


def _insert(header: InsertHeader, body: memoryview) -> Insert:
    if not len(header.first_steps) == len(header.rows) == len(header.transitions):
        raise MessageError("header", "the lists of an insert differ in length")
    arrays = unpack(body, _insert_specs(header))
    frames, rewards, discounts, priorities, starts, actions, spans = arrays
    _check("frames", frames, -LARGEST, LARGEST)
    _check("rewards", rewards, -LARGEST, LARGEST)
    _check("discounts", discounts, 0, 1)
    _check("priorities", priorities, -LARGEST, LARGEST)
    _check("spans", spans, 1, 255)
    _check_rows(header, starts, actions, spans)
    row_ends, item_ends = np.cumsum(header.rows), np.cumsum(header.transitions)
    chunks, row, item = [], 0, 0
    for first_step, row_end, item_end in zip(header.first_steps, row_ends.tolist(), item_ends.tolist(), strict=True):
        r, i = slice(row, row_end), slice(item, item_end)
        chunks.append(
            Chunk(first_step, frames[r], actions[r], starts[i], spans[i], rewards[i], discounts[i], priorities[i])
        )
        row, item = row_end, item_end
    return Insert(
        header.actor,
        header.incarnation,
        header.sequence,
        header.first_unacknowledged,
        header.learner_step,
        tuple(chunks),
    )


def _check_rows(
    header: InsertHeader, starts: NDArray[np.uint16], actions: NDArray[np.uint8], spans: NDArray[np.uint8]
) -> None:
    """Refuses transitions that leave their chunk or come out of order, and actions that do not exist."""
    rows = np.repeat(header.rows, header.transitions)
    if (starts.astype(np.int64) + spans >= rows).any():
        raise MessageError("value", "a transition reaches beyond its chunk")
    chunk = np.repeat(np.arange(len(header.rows)), header.transitions)
    if ((np.diff(starts.astype(np.int64)) <= 0) & (np.diff(chunk) == 0)).any():
        raise MessageError("value", "the starts of a chunk do not increase")
    unknown = actions >= NUM_ACTIONS
    last = np.cumsum(header.rows) - 1
    unknown[last] &= actions[last] != NO_ACTION
    if unknown.any():
        raise MessageError("value", "an action does not exist")


def _sample_specs(header: SampleHeader) -> list[ArraySpec]:
    size, echoes = header.size, (header.size, header.memory_steps * NUM_EARS, NUM_BINS)
    taken = (size, ACTION_MEMORY)
    floats: list[ArraySpec] = [*[(np.float32, (size,))] * 3, (np.float32, echoes), (np.float32, echoes)]
    return [(np.int64, (size,)), *floats, (np.uint8, taken), (np.uint8, taken), (np.uint8, (size,))]


def _sample(header: SampleHeader, body: memoryview) -> Sample:
    arrays = unpack(body, _sample_specs(header))
    items, weights, rewards, discounts, echoes, next_echoes, taken, next_taken, actions = arrays
    _check("items", items, 0, 2**62)
    _check("weights", weights, 0, 1)
    _check("discounts", discounts, 0, 1)
    for name, array in (("rewards", rewards), ("echoes", echoes), ("next echoes", next_echoes)):
        _check(name, array, -LARGEST, LARGEST)
    for array in (taken, next_taken, actions):
        _check("actions", array, 0, NUM_ACTIONS - 1)
    states, next_states = States(echoes, taken), States(next_echoes, next_taken)
    batch = Batch(items, weights, states, actions, rewards, discounts, next_states)
    return Sample(header.request, batch, header.standing)


def _priority_specs(header: PriorityHeader) -> list[ArraySpec]:
    return [(np.int64, (header.size,)), (np.float32, (header.size,))]


def _weights(header: WeightsHeader, body: memoryview) -> Weights:
    if len(header.names) != len(header.shapes) or len(set(header.names)) != len(header.names):
        raise MessageError("header", "names and shapes of the weights do not belong together")
    arrays = unpack(body, [(np.float32, shape) for shape in header.shapes])
    for name, array in zip(header.names, arrays, strict=True):
        _check(name, array, -LARGEST, LARGEST)
    return Weights(header.version, header.learner_step, dict(zip(header.names, arrays, strict=True)))


def _check(name: str, array: NDArray[np.generic], low: float, high: float) -> None:
    """Refuses values outside a closed range; NaN is outside every range."""
    if array.size and not (low <= array.min() and array.max() <= high):
        raise MessageError("value", f"{name} must be finite and within {low:g} and {high:g}")
