"""The learner's side of a replay server: requests for batches wait their turn, and are answered as the law allows.

A part of a batch, asked for by a learner that draws from several servers, waits for nothing but its turn: there the
learner keeps the law of all servers together, see `spread`. What a part is counted for by the rate limiter is told with
it, because it is drawn in proportion to priorities and the law is one of inserts.
"""

from __future__ import annotations

from collections.abc import Callable

from apex_bat.config.settings import Config
from apex_bat.replay.requests import Request, SampleRequests
from apex_bat.replay.store import ReplayStore
from apex_bat.transport.messages import Message, PartRequest, Sample, SampleRequest, Standing
from apex_bat.transport.refusals import Refusals


class Outlet:
    """Queues requests and answers them one by one.

    Args:
        config: the settings.
        store: what is drawn from.
        refusals: counts those that are refused.
        send: sends a peer a message; returns whether it went.

    Attributes:
        requests: those that wait.
    """

    def __init__(
        self, config: Config, store: ReplayStore, refusals: Refusals, send: Callable[[bytes, Message], bool]
    ) -> None:
        self._batch_size = config.learner.batch_size
        self._store, self._refusals, self._send = store, refusals, send
        self.requests = SampleRequests()

    def arrive(self, peer: bytes, request: Request) -> None:
        """Queues a request, or refuses it."""
        size = request.size if isinstance(request, PartRequest) else request.batch_size
        if size > self._batch_size or (size < self._batch_size and isinstance(request, SampleRequest)):
            self._refusals.count("batch_size", f"{size}; learner.batch_size is {self._batch_size}")
            return
        # Noted on arrival: when the request's turn comes, a later update may have told a later step.
        self._store.learner_step = request.learner_step
        if self.requests.offer(peer, request) == "flood":
            self._refusals.count("flood", f"{len(self.requests)} sample requests wait already")

    def answer_next(self) -> bool:
        """Answers the request whose turn it is; returns whether there was one that need not wait."""
        request = self.requests.peek()
        if request is None or (isinstance(request, SampleRequest) and not self._store.can_sample(request.batch_size)):
            return False
        peer, _ = self.requests.take()
        if isinstance(request, PartRequest):
            self._answer_part(peer, request)
            return True
        batch = self._store.sample(request.batch_size, self._store.learner_step)
        if self._send(peer, Sample(request.request, batch)):
            self._store.count_sample(request.batch_size)
        return True

    def _answer_part(self, peer: bytes, request: PartRequest) -> None:
        """Answers with a part and how this server stands when it is counted; with the latter only, if it is empty."""
        sampled = None
        if request.size and len(self._store.buffer):
            sampled = self._store.draw(request.size, self._store.learner_step)
        self._store.count_sample(request.charge)
        standing = self._standing(request.request, 0.0 if sampled is None else sampled.largest_weight)
        answer = standing if sampled is None else Sample(request.request, sampled.batch, standing)
        if not self._send(peer, answer):
            self._store.count_sample(-request.charge)

    def _standing(self, request: int, largest_weight: float) -> Standing:
        self._store.anneal()
        buffer, limiter = self._store.buffer, self._store.limiter
        return Standing(
            request, len(buffer), buffer.total, limiter.earned, self._store.beta, largest_weight,
            limiter.waiting_reason(),
        )  # fmt: skip
