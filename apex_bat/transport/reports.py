"""Reports of the roles to the launcher: that they live, what they do or wait for, and their figures."""

from __future__ import annotations

import logging
import math

import msgspec
import zmq

from apex_bat.transport.messages import MessageError, Report, decode, encode
from apex_bat.transport.refusals import Refusals
from apex_bat.transport.security import Keys
from apex_bat.transport.sockets import Connection, Listener

logger = logging.getLogger(__name__)

MAX_REPORT_BYTES = 1 << 20
AT_ONCE = 1000  # reports taken from the socket by one poll


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
        """Sends a report, without the metrics that are not finite; returns False if it was dropped."""
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

    Attributes:
        address: where it listens.
        refusals: counts of refused reports by reason.

    Raises:
        TransportError: the address cannot be used.
    """

    def __init__(self, address: str, *, keys: Keys | None = None, generation: int | None = None) -> None:
        self._listener = Listener(zmq.PULL, address, keys=keys, max_message_bytes=MAX_REPORT_BYTES)
        self._generation = generation
        self.address = self._listener.address
        self.refusals = Refusals(logger)

    def poll(self, timeout_s: float) -> list[Report]:
        """Returns the reports that are there, waiting up to `timeout_s` for the first."""
        reports: list[Report] = []
        wait_ms = int(timeout_s * 1000)
        while len(reports) < AT_ONCE and self._listener.socket.poll(wait_ms):
            wait_ms = 0
            try:
                message = decode(self._listener.socket.recv(zmq.NOBLOCK), self._generation)
            except MessageError as error:
                self.refusals.count(error.fault, str(error))
                continue
            if isinstance(message, Report):
                reports.append(message)
            else:
                self.refusals.count("unexpected", f"a {type(message).__name__} instead of a report")
        return reports

    def close(self) -> None:
        """Closes the socket; may be called twice."""
        self._listener.close()
