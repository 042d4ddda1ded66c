"""The actors' side of a replay server: what arrives from them, waits its turn, is stored or refused, and acknowledged.

An insert is acknowledged when it is stored, so an actor whose window of unacknowledged inserts is full waits: that is
how a slow learner slows the actors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from apex_bat.config.settings import Config
from apex_bat.replay.arrivals import Arrival, Arrivals, StoredSequence
from apex_bat.replay.store import RefusedChunkError, ReplayStore
from apex_bat.transport.messages import Ack, Insert, InsertHeader, Message
from apex_bat.transport.refusals import Refusals

MAX_QUEUED_MESSAGES = 8  # of the largest size that may be sent: as many bytes of inserts may wait, whoever sent them
COUNTS = ("received", "refused", "duplicates", "out_of_turn")


class Intake:
    """Takes inserts in and stores them one by one.

    Args:
        config: the settings.
        store: where they go, as its rate limiter lets them in.
        refusals: counts those that are refused.
        send: sends a peer a message.

    Attributes:
        counts: what became of them, by the names of `COUNTS`: the first two in transitions, the others in inserts.
    """

    def __init__(
        self, config: Config, store: ReplayStore, refusals: Refusals, send: Callable[[bytes, Message], object]
    ) -> None:
        self._arrivals = Arrivals(config.actor.window_chunks, MAX_QUEUED_MESSAGES * config.transport.max_message_bytes)
        self._store, self._refusals, self._send = store, refusals, send
        self.counts = dict.fromkeys(COUNTS, 0)

    def __len__(self) -> int:
        """Inserts that wait."""
        return len(self._arrivals)

    def arrive(self, peer: bytes, arrival: Arrival) -> None:
        """Queues an insert, or answers at once when it can never be stored or was stored before."""
        header = arrival.header
        verdict = self._arrivals.offer(arrival, peer)
        if verdict in ("stored", "held"):
            self.counts["duplicates"] += 1
        elif verdict in ("gap", "flood"):
            self.counts["out_of_turn"] += 1
        if verdict == "stored":
            self._send(peer, Ack(header.incarnation, header.sequence))
        elif verdict == "superseded":
            self._refusals.count("superseded", f"{header.actor}: another incarnation has taken its place")
            self._send(peer, Ack(header.incarnation, header.sequence, superseded=True))

    def store_next(self) -> bool:
        """Stores or refuses the insert whose turn it is; returns whether there was one that need not wait."""
        arrival = self._arrivals.peek()
        if arrival is None:
            return False
        header, reason, _ = arrival
        num_transitions = _num_transitions(header)
        if isinstance(header, Insert) and not reason:
            reason = self._store.limiter.refusal(num_transitions)
            if not reason and not self._store.can_add(num_transitions):
                return False
            reason = reason or self._add(header)
            if reason:
                self._refusals.count("chunk", f"{header.actor}: {reason}")
        if reason:
            self.counts["refused"] += num_transitions
        self.counts["received"] += num_transitions
        peer = self._arrivals.settle()
        if peer is not None:
            self._send(peer, Ack(header.incarnation, header.sequence, reason[:500]))
        return True

    def waiting_peers(self) -> set[bytes]:
        """Returns the connections of all actors with an insert that waits."""
        return set(self._arrivals.waiting_peers())

    def stored_sequences(self) -> dict[str, StoredSequence]:
        """Returns what a snapshot keeps of each actor."""
        return self._arrivals.stored_sequences()

    def restore(self, sequences: Mapping[str, Any], counts: Mapping[str, Any]) -> None:
        """Takes over what a snapshot says. Raises KeyError, IndexError, TypeError or ValueError if it is nonsense."""
        self._arrivals.restore({actor: StoredSequence(s[0], s[1], tuple(s[2])) for actor, s in sequences.items()})
        self.counts |= {name: int(counts[name]) for name in COUNTS}

    def _add(self, insert: Insert) -> str:
        """Stores an insert; returns why it cannot be stored, or nothing."""
        try:
            self._store.add(insert.actor, insert.learner_step, insert.chunks)
        except RefusedChunkError as error:
            return str(error).removeprefix(f"{insert.actor}: ")
        return ""


def _num_transitions(header: Insert | InsertHeader) -> int:
    if isinstance(header, InsertHeader):
        return sum(header.transitions)
    return sum(len(chunk.starts) for chunk in header.chunks)
