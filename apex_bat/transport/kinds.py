"""The kinds of messages: what each holds, and the header that carries it.

A message without arrays is its own header. One with arrays is a named tuple; its header tells their sizes. Limits on
numbers, texts and lists stand in the types and are checked when a header is decoded.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from apex_bat.experience import Batch, Chunk

MAX_ROWS = 65_535  # of a chunk: transitions name their rows in uint16

Name = Annotated[str, Meta(min_length=1, max_length=200)]
Text = Annotated[str, Meta(max_length=1000)]
Number = Annotated[int, Meta(ge=0, le=2**62)]
Rows = Annotated[int, Meta(ge=1, le=MAX_ROWS)]
Length = Annotated[int, Meta(ge=1, le=2**31)]
PerChunk = Meta(min_length=1, max_length=4096)


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind"):
    """What all headers share: a field `kind` that names the message."""


class InsertHeader(Header, frozen=True, tag="insert"):
    """Header of an `Insert`; the lists have one entry a chunk."""

    actor: Name
    incarnation: Number
    sequence: Number
    first_unacknowledged: Number
    learner_step: Number
    first_steps: Annotated[tuple[Number, ...], PerChunk]
    rows: Annotated[tuple[Rows, ...], PerChunk]
    transitions: Annotated[tuple[Rows, ...], PerChunk]


class Insert(NamedTuple):
    """Experience of an actor."""

    actor: str
    incarnation: int
    """Random number of this life of the actor; a restarted actor has another."""
    sequence: int
    """1, 2, ... within the incarnation. The server stores each number once, in order."""
    first_unacknowledged: int
    """Least sequence for which the actor still holds the data: none below it will come again."""
    learner_step: int
    """Updates that the weights which flew these chunks had seen."""
    chunks: tuple[Chunk, ...]


class Ack(Header, frozen=True, tag="ack"):
    """The server has stored an insert for good, or refused it for good."""

    incarnation: Number
    sequence: Number
    refused: Text = ""
    """Why it was refused; empty when it was stored."""
    superseded: bool = False
    """Another incarnation of this actor has taken its place: it must end."""


class Waiting(Header, frozen=True, tag="waiting"):
    """The server is alive and holds what was sent; for whom it waits."""

    reason: Text


class SampleRequest(Header, frozen=True, tag="request"):
    """Asks for one batch."""

    request: Number
    """Number that the answer repeats; a request sent twice is answered once while it is queued."""
    batch_size: Annotated[int, Meta(ge=1, le=65_536)]
    learner_step: Number


class PartRequest(Header, frozen=True, tag="part"):
    """Asks one of several servers for its part of a batch, which is drawn at once: whoever asks keeps the law.

    The part is as large as the server's share of all priorities; what its rate limiter counts follows from inserts.
    """

    request: Number
    size: Annotated[int, Meta(ge=0, le=65_536)]
    """Transitions to draw; with 0, or when nothing is held, a `Standing` is the answer."""
    charge: Annotated[int, Meta(ge=0, le=1 << 31)]
    """Samples that the rate limiter is to count for it."""
    learner_step: Number


class Standing(Header, frozen=True, tag="standing"):
    """How one of several servers stands: comes with each part, or is the whole answer to a request for nothing."""

    request: Number
    held: Number
    """Transitions."""
    total: Annotated[float, Meta(ge=0.0, le=1e18)]
    """Sum of their priorities, after the exponent."""
    earned: Number
    """Samples that its rate limiter would let out now."""
    beta: Annotated[float, Meta(ge=0.0, le=1.0)]
    """Exponent of the importance weights."""
    largest_weight: Annotated[float, Meta(ge=0.0, le=1e18)] = 0.0
    """By what the weights of the part were divided; 0 without a part."""
    reason: Text = ""
    """For whom the server waits."""


class SampleHeader(Header, frozen=True, tag="sample"):
    """Header of a `Sample`."""

    request: Number
    size: Annotated[int, Meta(ge=1, le=65_536)]
    memory_steps: Annotated[int, Meta(ge=1, le=255)]
    standing: Standing | None = None


class Sample(NamedTuple):
    """A batch, or one server's part of it, and the number of the request that it answers."""

    request: int
    batch: Batch
    standing: Standing | None = None
    """Of the server at the moment of the draw; with a part only."""


class PriorityHeader(Header, frozen=True, tag="priorities"):
    """Header of a `PriorityUpdate`."""

    learner_step: Number
    size: Annotated[int, Meta(ge=1, le=1 << 20)]


class PriorityUpdate(NamedTuple):
    """New |TD errors|: items int64 (size,), priorities float32 (size,)."""

    learner_step: int
    items: NDArray[np.int64]
    priorities: NDArray[np.float32]


class RatioChange(Header, frozen=True, tag="ratio"):
    """Asks the replay server for another law of the rate limiter; sent twice, it is the same law."""

    samples_per_insert: Annotated[float, Meta(gt=0.0, le=1e6)]
    error_buffer: Annotated[float, Meta(ge=0.0, le=1e12)] | None = None
    """Half-width of the band, samples; None: that of the settings, made as wide as the ratio needs."""


class Ratio(Header, frozen=True, tag="ratio_now"):
    """The law of the rate limiter that holds now: the answer to a `RatioChange`."""

    samples_per_insert: float
    error_buffer: float
    refused: Text = ""
    """Why the change was refused; empty when it was made."""


class WeightsHeader(Header, frozen=True, tag="weights"):
    """Header of `Weights`."""

    version: Number
    learner_step: Number
    names: Annotated[tuple[Name, ...], Meta(min_length=1, max_length=1024)]
    shapes: Annotated[tuple[Annotated[tuple[Length, ...], Meta(max_length=8)], ...], Meta(max_length=1024)]


class Weights(NamedTuple):
    """A network: float32 arrays by name."""

    version: int
    learner_step: int
    arrays: dict[str, NDArray[np.float32]]


class Subscription(Header, frozen=True, tag="subscription"):
    """Asks for the newest weights now, unless they are these, and for all that follow while it is renewed."""

    version: Annotated[int, Meta(ge=-1, le=2**62)]
    """Of the weights that the subscriber has; -1: it has none."""
    learner_step: Number


class Report(Header, frozen=True, tag="report"):
    """A role tells the launcher that it lives, and how."""

    role: Name
    pid: Number
    host: Text
    address: Text
    state: Text
    """What it does, or for whom it waits."""
    metrics: Annotated[dict[Name, float], Meta(max_length=1024)]


Message = (
    Insert
    | Ack
    | Waiting
    | SampleRequest
    | PartRequest
    | Standing
    | Sample
    | PriorityUpdate
    | RatioChange
    | Ratio
    | Weights
    | Subscription
    | Report
)
Headers = (
    InsertHeader
    | Ack
    | Waiting
    | SampleRequest
    | PartRequest
    | Standing
    | SampleHeader
    | PriorityHeader
    | RatioChange
    | Ratio
    | WeightsHeader
    | Subscription
    | Report
)
