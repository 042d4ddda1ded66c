"""Requests for batches that wait: one queue a learner, served in turn, so that none can crowd out another."""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Literal

from apex_bat.transport.messages import PartRequest, SampleRequest

MAX_EACH = 256  # of one connection; a learner asks for `learner.prefetch` ahead
MAX_PEERS = 64  # connections with a request that waits

Request = SampleRequest | PartRequest
Verdict = Literal["queued", "held", "flood"]
"""What became of a request: it waits now; it waited already; its sender, or all together, ask for too much."""


class SampleRequests:
    """Queues of requests, one a connection."""

    def __init__(self) -> None:
        self._queues: OrderedDict[bytes, deque[Request]] = OrderedDict()  # in the order in which they are served

    def __len__(self) -> int:
        """Requests that wait."""
        return sum(map(len, self._queues.values()))

    def offer(self, peer: bytes, request: Request) -> Verdict:
        """Takes a request of a connection in, if it is new and there is room."""
        queue = self._queues.get(peer)
        if queue is None:
            if len(self._queues) >= MAX_PEERS:
                return "flood"
            queue = self._queues[peer] = deque()
        if any(held.request == request.request for held in queue):
            return "held"
        if len(queue) >= MAX_EACH:
            return "flood"
        queue.append(request)
        return "queued"

    def peek(self) -> Request | None:
        """Returns whose turn it is, or None when nothing waits."""
        return next(iter(self._queues.values()))[0] if self._queues else None

    def take(self) -> tuple[bytes, Request]:
        """Removes what `peek` returned and returns it with its connection."""
        peer, queue = next(iter(self._queues.items()))
        request = queue.popleft()
        if queue:
            self._queues.move_to_end(peer)
        else:
            del self._queues[peer]
        return peer, request

    def peers(self) -> set[bytes]:
        """Returns the connections with a request that waits."""
        return set(self._queues)
