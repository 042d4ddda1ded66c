"""Every message that travels, as bytes and back.

    actor   -> replay   Insert            replay -> actor    Ack, Waiting
    learner -> replay   SampleRequest     replay -> learner  Sample, Waiting
    learner -> replay   PartRequest       replay -> learner  Sample, Standing
    learner -> replay   PriorityUpdate
    anybody -> replay   RatioChange       replay -> anybody  Ratio
    actor   -> learner  Subscription      learner -> actors  Weights
    any     -> launcher Report

`decode` either returns a message whose sizes, shapes, types and values are right or raises `MessageError`, whatever the
bytes. There is no pickle; see `framing` for the bytes, `kinds` for the messages and `bodies` for their arrays.
"""

from __future__ import annotations

import msgspec

from apex_bat.transport.bodies import put_together, taken_apart
from apex_bat.transport.framing import Data, MessageError, pack, split
from apex_bat.transport.kinds import (
    Ack,
    Headers,
    Insert,
    InsertHeader,
    Message,
    PartRequest,
    PriorityUpdate,
    Ratio,
    RatioChange,
    Report,
    Sample,
    SampleRequest,
    Standing,
    Subscription,
    Waiting,
    Weights,
)

__all__ = [
    "encode",
    "decode",
    "Message",
    "MessageError",
    "Insert",
    "InsertHeader",
    "Ack",
    "Waiting",
    "SampleRequest",
    "PartRequest",
    "Standing",
    "Sample",
    "PriorityUpdate",
    "RatioChange",
    "Ratio",
    "Weights",
    "Subscription",
    "Report",
]

_decoder = msgspec.msgpack.Decoder(Headers)
_encoder = msgspec.msgpack.Encoder()


def encode(message: Message, generation: int = 0) -> bytearray:
    """Returns the bytes of a message: a single part, to be sent as it is.

    Raises:
        ValueError: a chunk or array has a wrong shape or dtype.
    """
    header, arrays, specs = taken_apart(message)
    for array, (dtype, shape) in zip(arrays, specs, strict=True):
        if array.dtype != dtype or array.shape != shape:
            raise ValueError(f"{type(message).__name__}: an array is {array.dtype} {array.shape}, not {dtype} {shape}")
    return pack(_encoder.encode(header), arrays, generation)


def decode(data: Data, generation: int | None = None) -> Message:
    """Returns the message in some bytes; its arrays are views of them.

    Args:
        data: one received part.
        generation: generation that the sender must have; None accepts any.

    Raises:
        MessageError: the bytes are not a right message. No other exception, whatever the bytes.
    """
    head, body = split(data, generation)
    try:
        header = _decoder.decode(head)
    except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
        raise MessageError("header", str(error)[:200]) from error
    try:
        return put_together(header, body)
    except MessageError as error:
        error.head = header
        raise
