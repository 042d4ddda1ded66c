"""Reports of the roles to the launcher: that they live, what they do or wait for, and their figures."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection

import msgspec
import zmq

from apex_bat.transport.framing import split
from apex_bat.transport.messages import MessageError, Report, decode, encode
from apex_bat.transport.refusals import Refusals
from apex_bat.transport.security import Keys
from apex_bat.transport.sockets import Connection, Listener

logger = logging.getLogger(__name__)

MAX_REPORT_BYTES = 1 << 20
AT_ONCE = 1000  # messages taken from the socket by one poll, whatever they are


class Reporter:
    """A role's end. It never waits: a report that cannot go at once is dropped and counted.

    Args:
        address: of the launcher's collector.
        keys: CURVE keys, for an address that is not loopback.
        generation: of the address.

    Attributes:
        dropped: reports that found nobody.
    """

    def __init__(self, address: str, *, keys: Keys | None = None, generation: int = 0) -> None:
        # IMMEDIATE: without a connection nothing is queued, so that nobody gets old reports later.
        options: dict[int, int] = {zmq.IMMEDIATE: 1}
        self._connection = Connection(zmq.PUSH, address, keys=keys, max_message_bytes=MAX_REPORT_BYTES, options=options)
        self._generation = generation
        self.dropped = 0

    def send(self, report: Report) -> bool:
        """Sends a report, without the metrics that are not finite; returns False if it was dropped.

        Raises:
            TransportError: the launcher refused our keys.
        """
        self._connection.check()
        finite = {name: value for name, value in report.metrics.items() if math.isfinite(value)}
        try:
            data = encode(msgspec.structs.replace(report, metrics=finite), self._generation)
            self._connection.socket.send(data, zmq.NOBLOCK)
        except zmq.Again:
            self.dropped += 1
            return False
        return True

    def close(self) -> None:
        """Closes the socket; may be called twice."""
        self._connection.close()


class ReportCollector:
    """The launcher's end.

    Args:
        address: where to listen; port 0 takes any free one.
        keys: CURVE keys, for an address that is not loopback.
        generation: of this address; None accepts the reports of any.
        roles: names of the roles that may report; None: any. Reports choose the names of files.

    Attributes:
        address: where it listens.
        generations: of roles that were given one of their own for their present life; what a former life still says is
            refused. The others have `generation`.
        refusals: counts of refused reports and connections by reason.

    Raises:
        TransportError: the address cannot be used.
    """

    def __init__(
        self,
        address: str,
        *,
        keys: Keys | None = None,
        generation: int | None = None,
        roles: Collection[str] | None = None,
    ) -> None:
        self.refusals = Refusals(logger)
        self._listener = Listener(zmq.PULL, address, self.refusals, keys=keys, max_message_bytes=MAX_REPORT_BYTES)
        self._generation = generation
        self._roles = None if roles is None else set(roles)
        self.address = self._listener.address
        self.generations: dict[str, int] = {}

    def admit(self, role: str) -> None:
        """Lets a role more report."""
        if self._roles is not None:
            self._roles.add(role)

    def poll(self, timeout_s: float) -> list[Report]:
        """Returns the reports that are there, waiting up to `timeout_s` for the first message."""
        reports: list[Report] = []
        wait_ms = int(timeout_s * 1000)
        for _ in range(AT_ONCE):  # refused ones count too, or a flood of them would never let us go
            if not self._listener.socket.poll(wait_ms):
                break
            wait_ms = 0
            try:
                reports.append(self._checked(self._listener.socket.recv_multipart(zmq.NOBLOCK)))
            except MessageError as error:
                self.refusals.count(error.fault, str(error))
        return reports

    def _checked(self, parts: list[bytes]) -> Report:
        if len(parts) != 1:
            raise MessageError("parts", f"{len(parts)} instead of one")
        message = decode(parts[0], None if self.generations else self._generation)
        if not isinstance(message, Report):
            raise MessageError("unexpected", f"a {type(message).__name__} instead of a report")
        if self.generations:
            split(parts[0], self.generations.get(message.role, self._generation))
        if self._roles is not None and message.role not in self._roles:
            raise MessageError("role", f"{message.role} is no role of this run")
        return message

    def close(self) -> None:
        """Closes the socket; may be called twice."""
        self._listener.close()
