"""An actor's end of the replay, of one server or of several: inserts go to them in turn, each by a line of its own.

In turn and not to one server an actor, for three reasons. Every server gets the same mixture of experience, so the
transitions that all hold together are the newest ones, as with one server. A server that is away holds no actor up: the
next in turn with room takes its insert. And no server stays empty where there are fewer actors than servers.
"""

from __future__ import annotations

import math
import secrets
import time
from collections.abc import Sequence

import zmq

from apex_bat.experience import Chunk
from apex_bat.replay.reader import endpoints
from apex_bat.replay.writer import ReplayWriter
from apex_bat.transport.security import Keys


class TurnWriter:
    """Sends the chunks of one actor to the replay servers.

    Args:
        addresses: of the servers.
        actor: name, the same after a restart.
        window_chunks: chunks that may be unacknowledged, shared out over the servers evenly and rounded up. So it is
            one for each server where there are more servers than chunks, and fewer than this while some are away.
        first: number of the server that gets the first insert; another one for each actor spreads what they send.
        keys: CURVE keys, for addresses that are not loopback.
        generation: of the addresses, or of each.
    """

    def __init__(
        self,
        addresses: Sequence[str],
        actor: str,
        window_chunks: int,
        *,
        first: int = 0,
        keys: Keys | None = None,
        generation: int | Sequence[int] = 0,
    ) -> None:
        addresses, generations = endpoints(addresses, generation)
        window, incarnation = math.ceil(window_chunks / len(addresses)), secrets.randbits(62)
        self._writers: list[ReplayWriter] = []
        try:
            for address, each in zip(addresses, generations, strict=True):
                self._writers.append(
                    ReplayWriter(address, actor, window, keys=keys, generation=each, incarnation=incarnation)
                )
        except BaseException:
            self.close()
            raise
        self._turn = first % len(addresses)

    @property
    def has_room(self) -> bool:
        """Whether `send` may be called; otherwise call `poll` until it may."""
        return any(writer.has_room for writer in self._writers)

    @property
    def waiting(self) -> str:
        """For whom a server waits that said so; empty when all store at once."""
        return next((writer.waiting for writer in self._writers if writer.waiting), "")

    @property
    def unacknowledged(self) -> int:
        """Inserts that no server has answered for."""
        return sum(writer.unacknowledged for writer in self._writers)

    def send(self, chunks: Sequence[Chunk], learner_step: int) -> None:
        """Sends chunks as one insert to the next server in turn that has room. Their arrays must not change afterwards.

        Raises:
            ValueError: no server has room, or there are no chunks.
        """
        order = [(self._turn + k) % len(self._writers) for k in range(len(self._writers))]
        chosen = next((number for number in order if self._writers[number].has_room), self._turn)
        self._writers[chosen].send(chunks, learner_step)
        self._turn = (chosen + 1) % len(self._writers)

    def poll(self, timeout_s: float) -> None:
        """Handles answers, waiting up to `timeout_s` for one if something is unacknowledged, and sends what is due.

        Raises:
            TransportError: a server refused our keys, or another actor of this name has taken our place.
        """
        for writer in self._writers:
            writer.poll(0.0)
        if timeout_s <= 0.0 or not self.unacknowledged:
            return
        poller = zmq.Poller()
        for writer in self._writers:
            poller.register(writer.socket, zmq.POLLIN)
        if poller.poll(int(timeout_s * 1000)):
            for writer in self._writers:
                writer.poll(0.0)

    def flush(self, timeout_s: float) -> bool:
        """Waits until all is acknowledged, up to `timeout_s`; returns whether it is."""
        ends_s = time.monotonic() + timeout_s
        while self.unacknowledged and (left_s := ends_s - time.monotonic()) > 0:
            self.poll(min(left_s, 0.1))
        return not self.unacknowledged

    def redirect(self, addresses: Sequence[str], generation: int | Sequence[int]) -> None:
        """Goes to the servers at other addresses, with all that is unacknowledged.

        Raises:
            TransportError: an address cannot be used.
        """
        for writer, address, each in zip(self._writers, *endpoints(addresses, generation), strict=True):
            writer.redirect(address, each)

    def counters(self) -> dict[str, float]:
        """Returns the figures that `replay.metrics.WRITER_METRICS` describes, of all servers together."""
        each = [writer.counters() for writer in self._writers]
        return {name: sum(counters[name] for counters in each) for name in each[0]}

    def close(self) -> None:
        """Closes the sockets; what is unacknowledged may be lost. May be called twice."""
        for writer in self._writers:
            writer.close()
