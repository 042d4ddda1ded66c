"""A run as queues: actors, replay servers and a learner that share cores, simulated event by event from measured costs.

What takes part: CPU of every role, cores shared evenly by what runs on them, the servers' queues and their turns, the
actors' windows, the learner's prefetch, and the law of samples per insert. What does not: the network, memory, the
launcher and its files, starting, and anything that a loaded machine does to a process.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable
from itertools import count
from typing import NamedTuple

import numpy as np

FIRST_SHARE = 0.4  # of the simulated time that is left out: the replay fills
SPREAD = 0.1  # of the time that a chunk takes, so that actors do not march in step


class Costs(NamedTuple):
    """CPU, in seconds."""

    step_s: float
    """Of an actor for an environment step of one bat, everything included."""
    insert_s: float
    """Of a server for an insert of one chunk, acknowledged."""
    request_s: float
    """Of a server for any batch or part of one, new priorities included: what does not grow with its size."""
    item_s: float
    """The same for each transition of it."""
    update_s: float
    """Of the learner for an update, by its device: what does not grow with the batch."""
    update_item_s: float = 0.0
    """The same for each transition of the batch."""
    take_s: float = 0.0
    """Of the learner's host to take a batch and send its priorities, one after the other with the update."""
    take_item_s: float = 0.0
    """The same for each transition of the batch."""

    def learn_s(self, batch_size: int) -> float:
        """Returns the time of the learner for an update, taking the batch and sending its priorities included."""
        return self.update_s + self.take_s + batch_size * (self.update_item_s + self.take_item_s)


class Run(NamedTuple):
    """What is run, and where."""

    actors: int
    batch_size: int = 64
    chunk: int = 50
    samples_per_insert: float = 8.0
    min_size: int = 2000
    band: float = math.inf
    """Half-width of the rate limiter's band, samples; inf: nobody waits for anybody."""
    window_chunks: int = 16
    prefetch: int = 16
    servers: int = 1
    shared_cores: int | None = None
    """Cores on which everything runs; None: one for each process."""


class Outcome(NamedTuple):
    """What a run yields, from the simulated time that counts."""

    steps_per_s: float
    """Whose transitions are stored."""
    updates_per_s: float
    samples_per_insert: float
    server_busy: float
    """Share of the time in which a server works, the mean over the servers."""
    learner_busy: float
    actors_held: float
    """Share of the actors' time in which they wait for room in their window."""


class _Cores:
    """Cores that serve all work given to them evenly, none faster than one core does."""

    def __init__(self, number: int) -> None:
        self._number = number
        self._now_s = self._served_s = 0.0  # the time, and what each piece of work has got until then
        self._work: list[tuple[float, int, Callable[[], None]]] = []
        self._tickets = count()

    def give(self, now_s: float, work_s: float, done: Callable[[], None]) -> None:
        """Begins a piece of work."""
        self._advance(now_s)
        heapq.heappush(self._work, (self._served_s + work_s, next(self._tickets), done))

    def next_s(self) -> float:
        """Returns when the next piece of work ends."""
        return self._now_s + (self._work[0][0] - self._served_s) / self._speed if self._work else math.inf

    def finish(self, now_s: float) -> Callable[[], None]:
        """Ends that piece of work and returns what is to happen then."""
        self._advance(now_s)
        return heapq.heappop(self._work)[2]

    @property
    def _speed(self) -> float:
        return min(1.0, self._number / max(1, len(self._work)))

    def _advance(self, now_s: float) -> None:
        self._served_s += (now_s - self._now_s) * self._speed
        self._now_s = now_s


class _Server:
    """One replay server: two queues that take turns."""

    def __init__(self) -> None:
        self.inserts: deque[int] = deque()  # numbers of the actors
        self.parts: deque[_Batch] = deque()
        self.is_busy = False
        self.insert_is_next = False
        self.busy_s = 0.0


class _Batch:
    """A batch that is being put together."""

    def __init__(self, missing: int) -> None:
        self.missing = missing
        self.is_counted = False


class _Actor:
    """What an actor has under way at each server."""

    def __init__(self, servers: int, first: int) -> None:
        self.unacknowledged = [0] * servers
        self.turn = first % servers
        self.held_since_s: float | None = None


class Simulation:
    """One run; `outcome` simulates it."""

    def __init__(self, run: Run, costs: Costs, seed: int = 0) -> None:
        self._run, self._costs = run, costs
        self._generator = np.random.default_rng(seed)
        self._now_s = 0.0
        shared = _Cores(run.shared_cores) if run.shared_cores else None
        self._actor_cores = shared or _Cores(run.actors)
        self._server_cores = [shared or _Cores(1) for _ in range(run.servers)]
        self._learner_cores = shared or _Cores(1)
        self._cores = list({id(each): each for each in self._all_cores()}.values())
        self._servers = [_Server() for _ in range(run.servers)]
        self._actors = [_Actor(run.servers, number) for number in range(run.actors)]
        self._room = math.ceil(run.window_chunks / run.servers)
        self._ready = 0
        self._is_learning = False
        self._inserted = self._sampled = self._updates = 0
        self._learned_s = self._held_s = 0.0

    def outcome(self, duration_s: float) -> Outcome:
        """Simulates so many seconds and returns what the last part of them yields."""
        for number in range(self._run.actors):
            self._fly(number, first=True)
        for _ in range(self._run.prefetch):
            self._request()
        begin_s = FIRST_SHARE * duration_s
        self._until(begin_s)
        first, sampled = self._counters(), self._sampled
        self._until(duration_s)
        last, measured_s = self._counters(), duration_s - begin_s
        inserts, updates, busy_s, learned_s, held_s = (b - a for a, b in zip(first, last, strict=True))
        return Outcome(
            inserts / measured_s, updates / measured_s, (self._sampled - sampled) / inserts if inserts else 0.0,
            busy_s / measured_s / self._run.servers, learned_s / measured_s, held_s / measured_s / self._run.actors,
        )  # fmt: skip

    def _all_cores(self) -> list[_Cores]:
        return [self._actor_cores, *self._server_cores, self._learner_cores]

    def _counters(self) -> tuple[float, ...]:
        held_s = self._held_s + sum(
            self._now_s - actor.held_since_s for actor in self._actors if actor.held_since_s is not None
        )
        busy_s = sum(server.busy_s for server in self._servers)
        return self._inserted, self._updates, busy_s, self._learned_s, held_s

    def _until(self, end_s: float) -> None:
        while True:
            soonest = min(self._cores, key=_Cores.next_s)
            if soonest.next_s() > end_s:
                self._now_s = end_s
                return
            self._now_s = soonest.next_s()
            soonest.finish(self._now_s)()

    def _fly(self, number: int, first: bool = False) -> None:
        """Lets an actor fly until one of its bats has a chunk."""
        jitter = self._generator.random() if first else 1.0 + SPREAD * (self._generator.random() - 0.5)
        work_s = self._costs.step_s * self._run.chunk * jitter
        self._actor_cores.give(self._now_s, work_s, lambda: self._send(number))

    def _send(self, number: int) -> None:
        actor, servers = self._actors[number], self._run.servers
        order = ((actor.turn + k) % servers for k in range(servers))
        chosen = next(k for k in order if actor.unacknowledged[k] < self._room)
        actor.turn = (chosen + 1) % servers
        actor.unacknowledged[chosen] += 1
        self._servers[chosen].inserts.append(number)
        self._serve(chosen)
        if min(actor.unacknowledged) < self._room:
            self._fly(number)
        else:
            actor.held_since_s = self._now_s

    def _acknowledge(self, server: int, number: int) -> None:
        actor = self._actors[number]
        actor.unacknowledged[server] -= 1
        if actor.held_since_s is not None:
            self._held_s += self._now_s - actor.held_since_s
            actor.held_since_s = None
            self._fly(number)

    def _request(self) -> None:
        batch = _Batch(self._run.servers)
        for number, server in enumerate(self._servers):
            server.parts.append(batch)
            self._serve(number)

    def _serve(self, number: int) -> None:
        """Lets a server begin what it may do next, if it rests."""
        server = self._servers[number]
        if server.is_busy:
            return
        may_insert = bool(server.inserts) and self._may_insert()
        may_sample = bool(server.parts) and (server.parts[0].is_counted or self._may_sample())
        if may_insert and (server.insert_is_next or not may_sample):
            work_s, done = self._costs.insert_s, self._begun_insert(number)
        elif may_sample:
            work_s, done = self._part_s, self._begun_part(number)
        else:
            return
        server.is_busy, server.insert_is_next = True, not (may_insert and server.insert_is_next)
        server.busy_s += work_s
        self._server_cores[number].give(self._now_s, work_s, done)

    @property
    def _part_s(self) -> float:
        return self._costs.request_s + self._costs.item_s * self._run.batch_size / self._run.servers

    def _begun_insert(self, number: int) -> Callable[[], None]:
        actor = self._servers[number].inserts.popleft()
        self._inserted += self._run.chunk

        def done() -> None:
            self._servers[number].is_busy = False
            self._acknowledge(number, actor)
            self._serve_all()

        return done

    def _begun_part(self, number: int) -> Callable[[], None]:
        batch = self._servers[number].parts.popleft()
        if not batch.is_counted:
            batch.is_counted = True
            self._sampled += self._run.batch_size

        def done() -> None:
            self._servers[number].is_busy = False
            batch.missing -= 1
            if not batch.missing:
                self._ready += 1
                self._learn()
            self._serve_all()

        return done

    def _serve_all(self) -> None:
        for number in range(self._run.servers):
            self._serve(number)

    def _learn(self) -> None:
        if self._is_learning or not self._ready:
            return
        self._is_learning, self._ready = True, self._ready - 1
        work_s = self._costs.learn_s(self._run.batch_size)
        self._learned_s += work_s
        self._learner_cores.give(self._now_s, work_s, self._learned)

    def _learned(self) -> None:
        self._is_learning = False
        self._updates += 1
        self._request()
        self._learn()

    @property
    def _balance(self) -> float:
        return self._run.samples_per_insert * (self._inserted - self._run.min_size) - self._sampled

    def _may_insert(self) -> bool:
        is_filling = self._inserted < self._run.min_size
        return is_filling or self._balance + self._run.samples_per_insert * self._run.chunk <= self._run.band

    def _may_sample(self) -> bool:
        return self._inserted >= self._run.min_size and self._balance - self._run.batch_size >= -self._run.band
