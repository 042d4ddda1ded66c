"""What has arrived from the actors and waits to be stored: in order, once, and fairly.

An actor numbers its inserts 1, 2, ... and sends all that are not acknowledged again when it hears nothing. The server
takes only the next number of each actor (go-back-N), so one number tells what was stored, and a second copy of anything
is recognised. Each insert also tells the least number that may still come; it lets a server that lost its memory, or
has an older snapshot of it, go on without waiting for what was acknowledged before.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from apex_bat.transport.messages import Insert, InsertHeader

MAX_ACTORS = 65_535  # names remembered: each costs memory for ever, and a stranger could make up any number
MAX_RETIRED = 16  # incarnations remembered for each actor, so that a cut-off twin is recognised

Verdict = Literal["queued", "stored", "held", "gap", "superseded", "flood"]
"""What became of an arrival: it waits to be stored; it was stored before; it waits already; an earlier one is missing;
its sender was replaced by another of its name; its sender sends more than its window, or all together too much."""


class Arrival(NamedTuple):
    """An insert in the queue, or one that will be refused when its turn comes."""

    header: Insert | InsertHeader
    """The insert; only its header when its content was wrong."""
    refused: str
    """Why it must be refused, or empty."""
    num_bytes: int = 0
    """Size of the message that brought it."""


class StoredSequence(NamedTuple):
    """What a snapshot keeps of an actor."""

    incarnation: int
    sequence: int
    retired: tuple[int, ...]


@dataclass
class _Sender:
    incarnation: int
    stored: int  # every sequence up to this one is settled
    newest: int  # every sequence up to this one is settled or queued
    peer: bytes  # where acknowledgements go
    retired: deque[int] = field(default_factory=lambda: deque(maxlen=MAX_RETIRED))


class Arrivals:
    """Queues of inserts, one an actor, served in turn.

    Args:
        max_queued: inserts of one actor that may wait.
        max_bytes: of all inserts that wait; the first of an empty queue is taken however large it is.
    """

    def __init__(self, max_queued: int, max_bytes: int = 1 << 62) -> None:
        self._max_queued = max_queued
        self._max_bytes = max_bytes
        self._num_bytes = 0
        self._senders: dict[str, _Sender] = {}
        self._queues: OrderedDict[str, deque[Arrival]] = OrderedDict()  # in the order in which they are served

    def __len__(self) -> int:
        """Inserts that wait."""
        return sum(len(queue) for queue in self._queues.values())

    def offer(self, arrival: Arrival, peer: bytes) -> Verdict:
        """Takes an insert in, if it is the next of its actor.

        Args:
            arrival: what came.
            peer: the connection it came by; acknowledgements of this actor go there from now on.
        """
        header = arrival.header
        sender = self._senders.get(header.actor)
        if sender is None or sender.incarnation != header.incarnation:
            if sender is not None and header.incarnation in sender.retired:
                return "superseded"
            if sender is None and len(self._senders) >= MAX_ACTORS:
                return "flood"
            sender = self._welcome(header, peer, sender)
        sender.peer = peer
        if header.first_unacknowledged - 1 > sender.newest:
            sender.stored = sender.newest = header.first_unacknowledged - 1
        if header.sequence <= sender.stored:
            return "stored"
        if header.sequence <= sender.newest:
            return "held"
        if header.sequence > sender.newest + 1:
            return "gap"
        num_queued = len(self._queues.get(header.actor, ()))
        is_too_much = self._queues and self._num_bytes + arrival.num_bytes > self._max_bytes
        if num_queued >= self._max_queued or is_too_much:
            return "flood"
        self._queues.setdefault(header.actor, deque()).append(arrival)
        self._num_bytes += arrival.num_bytes
        sender.newest = header.sequence
        return "queued"

    def peek(self) -> Arrival | None:
        """Returns whose turn it is, or None when nothing waits."""
        return next(iter(self._queues.values()))[0] if self._queues else None

    def settle(self) -> bytes | None:
        """Removes what `peek` returned: it is stored or refused for good.

        Returns:
            The connection to acknowledge it to; None when its actor has been replaced meanwhile.
        """
        actor, queue = next(iter(self._queues.items()))
        header, _, num_bytes = queue.popleft()
        self._num_bytes -= num_bytes
        if queue:
            self._queues.move_to_end(actor)
        else:
            del self._queues[actor]
        sender = self._senders[actor]
        if sender.incarnation != header.incarnation:
            return None
        sender.stored = header.sequence
        return sender.peer

    def waiting_peers(self) -> list[bytes]:
        """Returns the connections of all actors with an insert in the queue."""
        return [self._senders[actor].peer for actor in self._queues]

    def stored_sequences(self) -> dict[str, StoredSequence]:
        """Returns what is stored of each actor. What only waits is not: its actor still holds it."""
        return {
            actor: StoredSequence(sender.incarnation, sender.stored, tuple(sender.retired))
            for actor, sender in self._senders.items()
        }

    def restore(self, sequences: dict[str, StoredSequence]) -> None:
        """Takes over what a snapshot says was stored."""
        self._queues.clear()
        self._num_bytes = 0
        self._senders = {
            actor: _Sender(s.incarnation, s.sequence, s.sequence, b"", deque(s.retired, MAX_RETIRED))
            for actor, s in sequences.items()
        }

    def _welcome(self, header: Insert | InsertHeader, peer: bytes, former: _Sender | None) -> _Sender:
        """Starts with a new incarnation. What waits of the former one is good experience and stays in the queue."""
        begun = header.first_unacknowledged - 1
        sender = _Sender(header.incarnation, begun, begun, peer)
        if former is not None:
            sender.retired.extend([*former.retired, former.incarnation])
        self._senders[header.actor] = sender
        return sender
