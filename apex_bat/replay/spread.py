"""Batches drawn from several replay servers as if they were one; `shares` has the arithmetic.

Each server gives a part of each batch, drawn at once. The learner's end keeps the law of samples per insert for the
draws: it begins a batch when the servers' laws together let it out, by what each told of itself with its last answer.
What they have earned since can only be more, so that this errs to the safe side. Inserts wait at each server by its own
law. Both cannot come to wait for each other: where a server holds inserts back it has earned at least a batch.

A server that cannot be reached is left out: its parts of batches under way are drawn again from the others, in
proportion to their totals, which leaves each of their items the probability it has without the lost one. It is charged
nothing meanwhile, is asked how it stands until it answers, and takes part again from then on.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from apex_bat.experience import Batch
from apex_bat.replay.asking import Send
from apex_bat.replay.shares import DrawnPart, charges, drawn_sizes, joined, misplaced_share
from apex_bat.transport.messages import Message, PartRequest, Sample, Standing, Waiting

LOOK_S = 0.02  # between questions how a server stands while no batch can be begun
CHECK_S = 0.25  # after which a server that owes an answer is asked whether it is there
STUCK_S = 0.25  # after which a server that takes no message is lost; a full queue has usually emptied by then
SMOOTHING = 0.01  # of the running mean over batches
_log = logging.getLogger(__name__)


class _Share(NamedTuple):
    """A part of a batch that a server was asked for, or only a question how it stands."""

    batch: int
    """Number of the batch; 0: only a question."""
    size: int = 0
    charge: int = 0
    chance: float = 0.0
    """With which a draw of the batch was given to this part."""


_QUESTION = _Share(0)


class _Gathering:
    """A batch in the making."""

    def __init__(self, num_servers: int) -> None:
        self.chances = np.zeros(num_servers)  # with which a draw was given to each server
        self.missing = 0  # parts that have not come
        self.parts: list[tuple[int, Batch, Standing]] = []
        self.is_patched = False  # whether a part was drawn again


class _Server:
    """What is known of one server."""

    def __init__(self) -> None:
        self.standing: Standing | None = None  # None: it is away
        self.outstanding: dict[int, _Share] = {}  # by request, in the order in which they were sent
        self.last_sent = 0  # request; later ones wait for room in the queue, or for the connection
        self.asked_s = float("-inf")
        self.heard_s = float("-inf")
        self.owes_since_s = float("-inf")
        self.stuck_since_s: float | None = None  # since when nothing could be sent
        self.is_doubted = False
        self.reason = ""

    @property
    def earned(self) -> int:
        """Samples that its law lets out beyond what is under way."""
        if self.standing is None:
            return 0
        return max(0, self.standing.earned - sum(share.charge for share in self.outstanding.values()))


class SpreadBatches:
    """Batches under way at several servers.

    Args:
        num_servers: how many.
        batch_size: transitions of a batch.
        send: sends a server a message.
        ask_again_s: silence after which a server that owes an answer counts as lost.
        generator: shares the draws out.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        num_servers: int,
        batch_size: int,
        send: Send,
        ask_again_s: float,
        generator: np.random.Generator,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._batch_size, self._send, self._ask_again_s = batch_size, send, ask_again_s
        self._generator, self._clock = generator, clock
        self._servers = [_Server() for _ in range(num_servers)]
        self._gathering: dict[int, _Gathering] = {}
        self._lost: deque[_Share] = deque()  # parts that are to be drawn again
        self._last_batch = self._last_request = 0
        self._learner_step = 0
        self._wants_more = False
        self._drawn_again = 0
        self._misplaced: float | None = None

    @property
    def under_way(self) -> int:
        """Batches that were begun and are not complete."""
        return len(self._gathering)

    @property
    def is_behind(self) -> bool:
        """Whether something is to be done soon, though nothing may come."""
        is_waited_for = any(each.standing is None or each.stuck_since_s is not None for each in self._servers)
        return self._wants_more or bool(self._lost) or is_waited_for

    def ask(self, missing: int, learner_step: int) -> None:
        """Begins up to so many batches, gives up lost servers, and asks how servers stand.

        Call it soon again, with `take` for what has come meanwhile: a server is given up when it was silent in two
        calls. So nobody loses servers by being stopped for a while itself.
        """
        self._learner_step = learner_step
        for number in range(len(self._servers)):
            self._send_outstanding(number)
        self._look_for_the_lost()
        self._draw_again()
        for _ in range(missing):
            if not self._can_draw() or sum(server.earned for server in self._servers) < self._batch_size:
                break
            self._begin()
            missing -= 1
        self._wants_more = missing > 0
        self._question()

    def take(self, number: int, message: Message) -> Batch | None:
        """Takes a message of a server; returns the batch if it is complete with that."""
        server = self._servers[number]
        server.heard_s = self._clock()
        if isinstance(message, Waiting):
            server.reason = message.reason
        standing = message.standing if isinstance(message, Sample) else message
        if not isinstance(standing, Standing):
            return None
        if server.standing is None and server.asked_s > float("-inf"):
            _log.info("replay server %d: holds %d transitions", number, standing.held)
        server.standing, server.reason = standing, standing.reason
        if standing.request not in server.outstanding:
            return None  # of a part that was given up meanwhile
        # A server answers in order: what was asked for before the answered one was lost.
        earlier = [request for request in server.outstanding if request < standing.request]
        self._give_up(number, [server.outstanding.pop(request) for request in earlier])
        share = server.outstanding.pop(standing.request)
        if isinstance(message, Sample):
            self._gathering[share.batch].parts.append((number, message.batch, standing))
        elif share.size:  # it holds nothing, but has counted the charge
            self._give_up(number, [share._replace(charge=0)])
            return None
        return self._settle(share.batch) if share.batch else None

    def moved(self, number: int) -> None:
        """Gives up what a server owes, whose place another has taken."""
        self._lose(number, "it has moved")

    def silent(self) -> int | None:
        """Returns the number of the first server if all are away, else None."""
        return None if any(server.standing for server in self._servers) else 0

    def reason(self) -> str:
        """Returns for whom the servers wait, as they said last; empty when they said nothing."""
        return next((server.reason for server in self._servers if server.reason), "")

    def counters(self) -> dict[str, float]:
        """Returns figures of `replay.metrics.READER_METRICS`."""
        return {
            "reader.servers_away": sum(server.standing is None for server in self._servers),
            "reader.parts_drawn_again": self._drawn_again,
            "reader.misplaced_share": self._misplaced or 0.0,
        }

    def _totals(self) -> list[float]:
        return [0.0 if server.standing is None else server.standing.total for server in self._servers]

    def _can_draw(self) -> bool:
        return sum(self._totals()) > 0.0

    def _begin(self) -> None:
        self._last_batch += 1
        self._gathering[self._last_batch] = _Gathering(len(self._servers))
        self._share_out(_Share(self._last_batch, self._batch_size, self._batch_size, 1.0))

    def _share_out(self, whole: _Share) -> None:
        """Asks the servers that are there for their parts of a batch, or of a part that was lost."""
        batch, totals = self._gathering[whole.batch], self._totals()
        chances = whole.chance * np.array(totals) / sum(totals)
        batch.chances += chances
        sizes = drawn_sizes(totals, whole.size, self._generator).tolist()
        charged = self._charges(whole.charge)
        shares = [_Share(whole.batch, *each) for each in zip(sizes, charged, chances.tolist(), strict=True)]
        for number, share in enumerate(shares):
            if share.size or share.charge:
                batch.missing += 1
                self._request(number, share)

    def _charges(self, amount: int) -> list[int]:
        """Returns what each server is charged: nothing those that are away, which would never answer for it."""
        there = [number for number, server in enumerate(self._servers) if server.standing is not None]
        charged = np.zeros(len(self._servers), np.int64)
        charged[there] = charges([self._servers[number].earned for number in there], amount)
        return charged.tolist()

    def _give_up(self, number: int, shares: Iterable[_Share]) -> None:
        """Lets parts that a server owes be drawn again by the next `ask`."""
        for share in shares:
            if share.size:
                # Its draws go to all servers anew, by chances of their own: none of the batch fell to it by this one.
                self._gathering[share.batch].chances[number] -= share.chance
                self._lost.append(share)
            elif share.batch:  # without draws nothing of its chance is lost
                self._lost.append(share._replace(chance=0.0))

    def _draw_again(self) -> None:
        """Draws lost parts from the servers that are there; they wait where none is."""
        while self._lost and self._can_draw():
            share = self._lost.popleft()
            self._drawn_again += 1
            self._gathering[share.batch].is_patched = True
            self._share_out(share)
            self._gathering[share.batch].missing -= 1

    def _settle(self, number: int) -> Batch | None:
        """Notes that a part has come; returns the batch if it was the last."""
        batch = self._gathering[number]
        batch.missing -= 1
        if batch.missing:
            return None
        del self._gathering[number]
        if not batch.is_patched:
            share = misplaced_share(batch.chances, self._totals())
            mean = share if self._misplaced is None else self._misplaced
            self._misplaced = mean + SMOOTHING * (share - mean)
        return joined([DrawnPart(*part, float(batch.chances[part[0]])) for part in batch.parts], len(self._servers))

    def _request(self, number: int, share: _Share) -> None:
        """Asks a server, at once or as soon as it can be sent to."""
        server, now_s = self._servers[number], self._clock()
        self._last_request += 1
        if not server.outstanding:
            server.owes_since_s = now_s
        server.outstanding[self._last_request] = share
        server.asked_s = now_s
        self._send_outstanding(number)

    def _send_outstanding(self, number: int) -> None:
        """Sends a server in order what it was not sent, as far as its queue has room."""
        server = self._servers[number]
        for request in [request for request in server.outstanding if request > server.last_sent]:
            share = server.outstanding[request]
            if not self._send(number, PartRequest(request, share.size, share.charge, self._learner_step)):
                server.stuck_since_s = self._clock() if server.stuck_since_s is None else server.stuck_since_s
                return
            server.last_sent = request
        server.stuck_since_s = None

    def _lose(self, number: int, why: str) -> None:
        server = self._servers[number]
        if server.standing is not None:
            _log.warning("replay server %d: %s; batches are drawn from the others", number, why)
        server.standing, server.reason, server.stuck_since_s = None, "", None
        lost = list(server.outstanding.values())
        server.outstanding.clear()
        self._give_up(number, lost)

    def _look_for_the_lost(self) -> None:
        now_s = self._clock()
        for number, server in enumerate(self._servers):
            silent_s = now_s - max(server.heard_s, server.owes_since_s) if server.outstanding else 0.0
            is_stuck = server.stuck_since_s is not None and now_s - server.stuck_since_s > STUCK_S
            is_missed = is_stuck or silent_s > self._ask_again_s
            if is_missed and server.is_doubted:
                self._lose(number, "it cannot be reached" if is_stuck else "it does not answer")
            server.is_doubted = is_missed

    def _question(self) -> None:
        """Asks how servers stand: those that are away, all while nothing can be begun, and else now and then."""
        now_s = self._clock()
        for number, server in enumerate(self._servers):
            is_urgent = (server.standing is None or self._wants_more) and not server.outstanding
            is_hopeless = server.standing is None and server.outstanding
            if not is_hopeless and now_s - server.asked_s >= (LOOK_S if is_urgent else CHECK_S):
                self._request(number, _QUESTION)
