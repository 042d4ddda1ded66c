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
from apex_bat.replay.asking import WholeBatches
from apex_bat.replay.heap import keep_freed_memory
from apex_bat.replay.metrics import READER_METRICS
from apex_bat.replay.spread import SpreadBatches
from apex_bat.transport.messages import Message, MessageError, PriorityUpdate, decode, encode
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
        address: of the replay server, or of several that share the transitions: each batch is drawn from all of them
            as if they were one, see `spread`, and item number n of server k of K appears as n K + k.
        batch_size: transitions of a batch.
        prefetch: batches asked for ahead.
        learner_step: updates that the learner has done already.
        keys: CURVE keys, for an address that is not loopback.
        generation: of the address, or of each.
        ask_again_s: silence of a server after which everything outstanding is asked for again.
        max_message_bytes: of a message from the server.
        generator: shares batches out over several servers; None: one of its own.
    """

    def __init__(
        self,
        address: str | Sequence[str],
        batch_size: int,
        prefetch: int,
        *,
        learner_step: int = 0,
        keys: Keys | None = None,
        generation: int | Sequence[int] = 0,
        ask_again_s: float = ASK_AGAIN_S,
        max_message_bytes: int = MAX_MESSAGE_BYTES,
        generator: np.random.Generator | None = None,
    ) -> None:
        keep_freed_memory()
        addresses, self._generations = endpoints(address, generation)
        self._batch_size = batch_size
        self._prefetch = prefetch
        # IMMEDIATE: without a connection nothing is queued, so that a new server is not met with old requests.
        options: dict[int, int] = {zmq.IMMEDIATE: 1}
        self._connections = [
            Connection(zmq.DEALER, each, keys=keys, max_message_bytes=max_message_bytes, options=options)
            for each in addresses
        ]
        self._batches: WholeBatches | SpreadBatches = WholeBatches(batch_size, self._send, ask_again_s)
        if len(addresses) > 1:
            generator = generator or np.random.default_rng()
            self._batches = SpreadBatches(len(addresses), batch_size, self._send, ask_again_s, generator)
        self._learner_step = learner_step
        self._ready: deque[Batch] = deque()
        self._updates: deque[tuple[int, NDArray[np.int64], NDArray[np.float32]]] = deque(maxlen=MAX_UPDATES)
        self._arrived = threading.Condition()
        self._error: Exception | None = None
        self._stopping = False
        self._moves: deque[tuple[list[str], list[int]]] = deque(maxlen=1)  # taken out whole, while another comes in
        self.waited_s = 0.0
        self.received = 0
        self._crowded_out = self._unsent = 0  # updates; each counted by one thread only
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
            self._crowded_out += 1
        self._updates.append((self._learner_step, items, priorities))
        if 2 * len(self._updates) >= self._prefetch:
            self._wake()

    def redirect(self, address: str | Sequence[str], generation: int | Sequence[int]) -> None:
        """Goes to the servers at other addresses from now on; what is outstanding is asked for there."""
        self._moves.append(endpoints(address, generation))
        self._wake()

    @property
    def waiting(self) -> str:
        """Why there is no batch, in one line; empty when there is one."""
        if self._ready:
            return ""
        silent = self._batches.silent()
        if silent is not None:
            return f"no answer from the replay server at {self._connections[silent].address}"
        return self._batches.reason() or "a batch is on its way"

    def counters(self) -> dict[str, float]:
        """Returns the figures that `replay.metrics.READER_METRICS` describes."""
        return (
            dict.fromkeys(READER_METRICS, 0.0)
            | {
                "reader.received": self.received,
                "reader.ready": len(self._ready),
                "reader.waited_s": self.waited_s,
                "reader.dropped_updates": self._crowded_out + self._unsent,
                "reader.refused_messages": self.refused_messages,
            }
            | self._batches.counters()
        )

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
        for connection in self._connections:
            poller.register(connection.socket, zmq.POLLIN)
        try:
            while not self._stopping:
                self._follow()
                self._batches.ask(self._prefetch - len(self._ready) - self._batches.under_way, self._learner_step)
                poller.poll(int((RETRY_S if self._batches.is_behind else WAKE_S) * 1000))
                while self._alarmed.poll(0):
                    self._alarmed.recv(zmq.NOBLOCK)
                self._send_updates()
                for number, connection in enumerate(self._connections):
                    self._receive(number, connection)
                    connection.check()
            self._send_updates()
        except Exception as error:  # whatever it is, `next` raises it: a thread that is gone would be waited for
            with self._arrived:
                self._error = error
                self._arrived.notify_all()
        finally:
            for connection in self._connections:
                connection.close()

    def _follow(self) -> None:
        """Goes where the servers have gone, and asks them again for what the former ones owe."""
        try:
            move = self._moves.popleft()
        except IndexError:
            return
        for number, (address, generation) in enumerate(zip(*move, strict=True)):
            connection = self._connections[number]
            if (address, generation) != (connection.address, self._generations[number]):
                connection.redirect(address)
                self._generations[number] = generation
                self._batches.moved(number)

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
        num_servers = len(self._connections)
        for number in range(num_servers):
            mine = items % num_servers == number
            if not mine.any():
                continue
            local = (items[mine] // num_servers).astype(np.int64)
            is_sent &= self._send(number, PriorityUpdate(steps[-1], local, priorities[mine].astype(np.float32)))
        self._unsent += 0 if is_sent else len(updates)

    def _receive(self, number: int, connection: Connection) -> None:
        while connection.socket.poll(0):
            # Into a bytearray: arrays over it can be written to, as torch.from_numpy wants them.
            data = bytearray(connection.socket.recv(zmq.NOBLOCK, copy=False).buffer)
            try:
                message = decode(data, self._generations[number])
            except MessageError:
                self.refused_messages += 1
                continue
            batch = self._batches.take(number, message)
            if batch is not None:
                with self._arrived:
                    self.received += 1
                    self._ready.append(batch)
                    self._arrived.notify_all()

    def _send(self, number: int, message: Message) -> bool:
        try:
            self._connections[number].socket.send(encode(message, self._generations[number]), zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True


def endpoints(address: str | Sequence[str], generation: int | Sequence[int]) -> tuple[list[str], list[int]]:
    """Returns the addresses of some servers and the generation of each; one generation may be that of all."""
    addresses = [address] if isinstance(address, str) else list(address)
    generations = [generation] * len(addresses) if isinstance(generation, int) else list(generation)
    return addresses, generations
