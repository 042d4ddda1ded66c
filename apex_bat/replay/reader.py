"""The learner's end of the replay: batches asked for ahead and decoded off the training thread, priorities back."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence

import numpy as np
import zmq
from numpy.typing import NDArray

from apex_bat.experience import Batch
from apex_bat.replay.heap import keep_freed_memory
from apex_bat.transport.messages import MessageError, PriorityUpdate, Sample, SampleRequest, Waiting, decode, encode
from apex_bat.transport.security import Keys
from apex_bat.transport.sockets import MAX_MESSAGE_BYTES, Connection

ASK_AGAIN_S = 2.0  # silence of a server after which its requests go again; a living one speaks each half second
WAKE_S = 0.1  # longest sleep of the thread, so that deadlines are seen
RETRY_S = 0.02  # the same while there is no connection
MAX_UPDATES = 1024  # priority updates that may wait for the thread
MAX_ITEMS = 1 << 20  # of one message: what the wire lets through


class ReplayReader:
    """Keeps `prefetch` batches under way or ready. One thread owns the sockets; one other thread may call the methods.

    Args:
        address: of the replay server, or of several that share the transitions: they are asked in turn, and item number
            n of server k of K appears as n K + k.
        batch_size: transitions of a batch.
        prefetch: batches asked for ahead.
        learner_step: updates that the learner has done already.
        keys: CURVE keys, for an address that is not loopback.
        generation: of the address.
        ask_again_s: silence of a server after which everything outstanding is asked for again.
        max_message_bytes: of a message from the server.
    """

    def __init__(
        self,
        address: str | Sequence[str],
        batch_size: int,
        prefetch: int,
        *,
        learner_step: int = 0,
        keys: Keys | None = None,
        generation: int = 0,
        ask_again_s: float = ASK_AGAIN_S,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
    ) -> None:
        keep_freed_memory()
        addresses = [address] if isinstance(address, str) else list(address)
        self._batch_size = batch_size
        self._prefetch = prefetch
        self._generation = generation
        self._ask_again_s = ask_again_s
        # IMMEDIATE: without a connection nothing is queued, so that a new server is not met with old requests.
        options: dict[int, int] = {zmq.IMMEDIATE: 1}
        self._servers = [
            _Server(Connection(zmq.DEALER, each, keys=keys, max_message_bytes=max_message_bytes, options=options))
            for each in addresses
        ]
        self._learner_step = learner_step
        self._ready: deque[Batch] = deque()
        self._updates: deque[tuple[int, NDArray[np.int64], NDArray[np.float32]]] = deque(maxlen=MAX_UPDATES)
        self._arrived = threading.Condition()
        self._error: Exception | None = None
        self._stopping = False
        self._last_request = 0
        self.waited_s = 0.0
        self.received = 0
        self.asked_again = 0
        self.dropped_updates = 0
        self.refused_messages = 0
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._alarm, self._alarmed = self._context.socket(zmq.PAIR), self._context.socket(zmq.PAIR)
        self._alarmed.bind("inproc://wake")
        self._alarm.connect("inproc://wake")
        self._thread = threading.Thread(target=self._run, name="replay-reader", daemon=True)
        self._thread.start()

    def next(self, timeout_s: float) -> Batch | None:
        """Returns the next batch, or None if none came within `timeout_s`; `waiting` then says why.

        Raises:
            TransportError: a server refused our keys.
            Exception: what else has ended the thread.
        """
        begun_s = time.monotonic()
        with self._arrived:
            self._arrived.wait_for(lambda: self._ready or self._error, timeout_s)
            batch = self._ready.popleft() if self._ready else None
        self.waited_s += time.monotonic() - begun_s
        if batch is None and self._error is not None:
            raise self._error
        # Not for each batch: waking the thread costs the caller, by way of the GIL, as much as decoding one (measured).
        if 2 * len(self._ready) <= self._prefetch:
            self._wake()
        return batch

    def update(self, items: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Sends new |TD errors| of items, without waiting. One call is one update of the learner, and counted so."""
        if len(items) != len(priorities):
            raise ValueError(f"{len(priorities)} priorities for {len(items)} items")
        self._learner_step += 1
        if len(self._updates) == MAX_UPDATES:
            self.dropped_updates += 1
        self._updates.append((self._learner_step, items, priorities))
        if 2 * len(self._updates) >= self._prefetch:
            self._wake()

    @property
    def waiting(self) -> str:
        """Why there is no batch, in one line; empty when there is one."""
        if self._ready:
            return ""
        silent = [server.connection.address for server in self._servers if server.is_silent(self._ask_again_s)]
        if silent:
            return f"no answer from the replay server at {silent[0]}"
        return next((server.reason for server in self._servers if server.reason), "a batch is on its way")

    def counters(self) -> dict[str, float]:
        """Returns the figures that `replay.metrics.READER_METRICS` describes."""
        return {
            "reader.received": self.received,
            "reader.ready": len(self._ready),
            "reader.waited_s": self.waited_s,
            "reader.asked_again": self.asked_again,
            "reader.dropped_updates": self.dropped_updates,
            "reader.refused_messages": self.refused_messages,
        }

    def close(self) -> None:
        """Sends the updates that still wait, ends the thread and closes the sockets; may be called twice."""
        if self._stopping:
            return
        self._stopping = True
        self._wake()
        self._thread.join()
        self._alarm.close(linger=0)
        self._alarmed.close(linger=0)
        self._context.destroy(linger=0)

    def _wake(self) -> None:
        try:
            self._alarm.send(b"", zmq.NOBLOCK)
        except zmq.Again:
            return  # enough alarms wait already

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._alarmed, zmq.POLLIN)
        for server in self._servers:
            poller.register(server.connection.socket, zmq.POLLIN)
        try:
            while not self._stopping:
                self._ask()
                is_behind = any(server.unsent for server in self._servers)
                poller.poll(int((RETRY_S if is_behind else WAKE_S) * 1000))
                while self._alarmed.poll(0):
                    self._alarmed.recv(zmq.NOBLOCK)
                self._send_updates()
                for shard, server in enumerate(self._servers):
                    self._receive(shard, server)
                    server.connection.check()
            self._send_updates()
        except Exception as error:  # whatever it is, `next` raises it: a thread that is gone would be waited for
            with self._arrived:
                self._error = error
                self._arrived.notify_all()
        finally:
            for server in self._servers:
                server.connection.close()

    def _ask(self) -> None:
        """Asks for as many batches as are missing, and again where a server has been silent for long."""
        missing = self._prefetch - len(self._ready) - sum(len(server.outstanding) for server in self._servers)
        for _ in range(missing):
            self._last_request += 1
            server = self._servers[self._last_request % len(self._servers)]
            if not server.outstanding:
                server.heard_s = time.monotonic()
            server.outstanding[self._last_request] = 0
            server.unsent.add(self._last_request)
        for server in self._servers:
            if server.is_silent(self._ask_again_s) and time.monotonic() - server.asked_again_s > self._ask_again_s:
                server.asked_again_s = time.monotonic()  # not heard_s: `waiting` goes on saying that it is silent
                self.asked_again += len(server.outstanding.keys() - server.unsent)
                server.unsent |= server.outstanding.keys()
            for request in sorted(server.unsent):
                message = SampleRequest(request, self._batch_size, self._learner_step)
                if not _send(server, encode(message, self._generation)):
                    break
                server.unsent.remove(request)
                server.num_sent += 1
                server.outstanding[request] = server.num_sent

    def _send_updates(self) -> None:
        """Sends all updates that wait, as few messages."""
        while self._updates:
            number = min(len(self._updates), max(1, MAX_ITEMS // self._batch_size))
            self._send_joined([self._updates.popleft() for _ in range(number)])

    def _send_joined(self, updates: Sequence[tuple[int, NDArray[np.int64], NDArray[np.float32]]]) -> None:
        """Sends updates as one message a server; of an item that comes twice the later one counts."""
        steps, items_each, priorities_each = zip(*updates, strict=True)
        items, priorities = np.concatenate(items_each), np.concatenate(priorities_each)
        is_sent = True
        for shard, server in enumerate(self._servers):
            mine = items % len(self._servers) == shard
            if not mine.any():
                continue
            local = (items[mine] // len(self._servers)).astype(np.int64)
            message = PriorityUpdate(steps[-1], local, priorities[mine].astype(np.float32))
            is_sent &= _send(server, encode(message, self._generation))
        self.dropped_updates += 0 if is_sent else len(updates)

    def _receive(self, shard: int, server: _Server) -> None:
        while server.connection.socket.poll(0):
            # Into a bytearray: arrays over it can be written to, as torch.from_numpy wants them.
            data = bytearray(server.connection.socket.recv(zmq.NOBLOCK, copy=False).buffer)
            try:
                message = decode(data, self._generation)
            except MessageError:
                self.refused_messages += 1
                continue
            server.heard_s = time.monotonic()
            if isinstance(message, Waiting):
                server.reason = message.reason
            elif isinstance(message, Sample) and message.request in server.outstanding:
                self._forget(server, message.request)
                server.reason = ""
                items = message.batch.items * len(self._servers) + shard
                with self._arrived:
                    self.received += 1
                    self._ready.append(message.batch._replace(items=items))
                    self._arrived.notify_all()

    def _forget(self, server: _Server, answered: int) -> None:
        """Notes an answer. A server answers in order: what was sent before it was lost, and goes again."""
        place = server.outstanding.pop(answered)
        server.unsent.discard(answered)
        lost = {request for request, sent in server.outstanding.items() if sent < place} - server.unsent
        self.asked_again += len(lost)
        server.unsent |= lost


class _Server:
    """What the reader knows of one server."""

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.outstanding: dict[int, int] = {}  # requests without an answer, and the how manieth to be sent each was
        self.num_sent = 0
        self.unsent: set[int] = set()  # those of them that must still go, or go again
        self.reason = ""
        self.heard_s = time.monotonic()
        self.asked_again_s = float("-inf")

    def is_silent(self, longer_than_s: float) -> bool:
        """Whether it owes an answer and has said nothing for long."""
        return bool(self.outstanding) and time.monotonic() - self.heard_s > longer_than_s


def _send(server: _Server, data: bytearray) -> bool:
    try:
        server.connection.socket.send(data, zmq.NOBLOCK)
    except zmq.Again:
        return False
    return True
