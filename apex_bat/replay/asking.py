"""Asking one replay server for whole batches: ahead, again after a silence, and again for what was lost on the way.

The server's rate limiter decides when a request is answered. `spread` does the same for several servers.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from apex_bat.experience import Batch
from apex_bat.transport.messages import Message, Sample, SampleRequest, Waiting

Send = Callable[[int, Message], bool]
"""Sends server number k a message; returns False when there is no connection."""


class WholeBatches:
    """Requests for batches at one server.

    Args:
        batch_size: transitions of a batch.
        send: to the server, which has number 0.
        ask_again_s: silence after which everything outstanding is asked for again.
        clock: seconds, monotonic.

    Attributes:
        asked_again: requests that were sent again.
        is_behind: whether something must still be sent.
    """

    def __init__(
        self, batch_size: int, send: Send, ask_again_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._batch_size, self._send, self._ask_again_s, self._clock = batch_size, send, ask_again_s, clock
        self._outstanding: dict[int, int] = {}  # requests without an answer, and the how manieth to be sent each was
        self._unsent: set[int] = set()  # those of them that must still go, or go again
        self._num_sent = 0
        self._last_request = 0
        self._reason = ""
        self._heard_s = clock()
        self._asked_again_s = float("-inf")
        self.asked_again = 0

    @property
    def under_way(self) -> int:
        """Batches that were asked for and have not come."""
        return len(self._outstanding)

    @property
    def is_behind(self) -> bool:
        """Whether something must still be sent."""
        return bool(self._unsent)

    def ask(self, missing: int, learner_step: int) -> None:
        """Asks for so many batches more, and again after a long silence."""
        if missing > 0 and not self._outstanding:
            self._heard_s = self._clock()
        for _ in range(missing):
            self._last_request += 1
            self._outstanding[self._last_request] = 0
            self._unsent.add(self._last_request)
        now_s = self._clock()
        if self._is_silent() and now_s - self._asked_again_s > self._ask_again_s:
            self._asked_again_s = now_s  # not _heard_s: `waiting` goes on saying that it is silent
            self.asked_again += len(self._outstanding.keys() - self._unsent)
            self._unsent |= self._outstanding.keys()
        for request in sorted(self._unsent):
            if not self._send(0, SampleRequest(request, self._batch_size, learner_step)):
                break
            self._unsent.remove(request)
            self._num_sent += 1
            self._outstanding[request] = self._num_sent

    def take(self, server: int, message: Message) -> Batch | None:
        """Takes a message of the server; returns the batch if it brought one that was asked for."""
        del server
        self._heard_s = self._clock()
        if isinstance(message, Waiting):
            self._reason = message.reason
        if not isinstance(message, Sample) or message.request not in self._outstanding:
            return None
        self._reason = ""
        place = self._outstanding.pop(message.request)
        self._unsent.discard(message.request)
        # A server answers in order: what was sent before the answered one was lost.
        lost = {request for request, sent in self._outstanding.items() if sent < place} - self._unsent
        self.asked_again += len(lost)
        self._unsent |= lost
        return message.batch

    def moved(self, server: int) -> None:
        """Asks the successor of the server for all that is outstanding."""
        del server
        self._reason = ""
        self._unsent |= self._outstanding.keys()

    def silent(self) -> int | None:
        """Returns the number of a server that owes an answer and has said nothing for long, or None."""
        return 0 if self._is_silent() else None

    def reason(self) -> str:
        """Returns for whom the server waits, as it said last; empty when it said nothing."""
        return self._reason

    def counters(self) -> dict[str, float]:
        """Returns figures of `replay.metrics.READER_METRICS`."""
        return {"reader.asked_again": self.asked_again}

    def _is_silent(self) -> bool:
        return bool(self._outstanding) and self._clock() - self._heard_s > self._ask_again_s
