"""What happens to connections before a message comes: refused handshakes, seen from both ends.

ZeroMQ tells neither end in its calls: a client that is refused would wait for ever, and a server would never know who
knocks. Both read the events of the socket's monitor.
"""

from __future__ import annotations

import errno
import struct
import threading

import zmq
from zmq.utils.monitor import recv_monitor_message

from apex_bat.transport.refusals import Refusals
from apex_bat.transport.security import TransportError

CLOSED_IN_A_ROW = 5  # handshakes cut by the server until a client believes that it is refused: about two seconds

_ENDED = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
_BROKEN = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
_DENIED = zmq.EVENT_HANDSHAKE_FAILED_AUTH
_SUCCEEDED = zmq.EVENT_HANDSHAKE_SUCCEEDED
_EVENT = struct.Struct("=HI")  # number and value of an event, as libzmq's monitor sends them


class HandshakeWatch:
    """Notices that a server refuses us: the socket itself would wait in silence for ever.

    A server that denies the key says so, once. One that cannot read our handshake, because it expects another key or
    none, just closes the connection; so does a server that is killed at that moment, and therefore only several in a
    row count. A handshake that times out is a server that hangs, which is not a refusal.
    """

    def __init__(self, socket: zmq.Socket[bytes], address: str) -> None:
        self._address = address
        self._socket = socket
        self._closed_in_a_row = 0
        self._reason = ""
        self._monitor: zmq.Socket[bytes] = socket.get_monitor_socket(_ENDED | _BROKEN | _DENIED | _SUCCEEDED)

    def check(self) -> None:
        """Raises TransportError if the server has refused us."""
        while self._monitor.poll(0):
            message = recv_monitor_message(self._monitor)
            event, value = message["event"], int(message["value"])
            if event == _SUCCEEDED:
                self._closed_in_a_row = 0
            elif event == _DENIED:
                self._reason = "our key is not in the server's allowed_clients"
            elif event == _BROKEN:
                self._reason = "one side has keys and the other has none, or not those of this run"
            elif value in (errno.EPIPE, errno.ECONNRESET):
                self._closed_in_a_row += 1
        if self._closed_in_a_row >= CLOSED_IN_A_ROW:
            self._reason = "it ends every handshake; are the keys those of this run, and does the server need keys?"
        if self._reason:
            raise TransportError(f"{self._address}: authentication refused: {self._reason}")

    def begin_anew(self, address: str) -> None:
        """Forgets what the former server did: the socket goes to another address."""
        while self._monitor.poll(0):
            self._monitor.recv_multipart(zmq.NOBLOCK)
        self._address, self._closed_in_a_row, self._reason = address, 0, ""

    def close(self) -> None:
        """Ends the watch; call it before the socket is closed."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)


class AcceptWatch:
    """Counts, in a thread, the handshakes that fail at a listening socket, and the connections that end.

    The thread is needed: libzmq waits with everything else when nobody takes its events.

    Args:
        socket: a socket that is not bound yet.
        refusals: where failed handshakes are counted. Denied keys are counted by the authenticator, which knows them.

    Attributes:
        num_ended: connections that were open and ended: orderly, lost, or closed because they sent what breaks the
            protocol or is larger than allowed, which libzmq does not tell apart.
    """

    def __init__(self, socket: zmq.Socket[bytes], refusals: Refusals) -> None:
        self.num_ended = 0
        self._socket = socket
        self._refusals = refusals
        self._failed = 0
        events = _ENDED | _BROKEN | _DENIED | zmq.EVENT_DISCONNECTED | zmq.EVENT_MONITOR_STOPPED
        self._monitor: zmq.Socket[bytes] = socket.get_monitor_socket(events)
        self._thread = threading.Thread(target=self._run, name="accept-watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread; call it before the socket is closed."""
        self._socket.disable_monitor()
        self._thread.join()

    def _run(self) -> None:
        while True:
            try:
                frame, _ = self._monitor.recv_multipart()
            except zmq.ContextTerminated:
                break
            event, value = _EVENT.unpack(frame)
            if event == zmq.EVENT_MONITOR_STOPPED:
                break
            self._take(event, value)
        self._monitor.close(linger=0)

    def _take(self, event: int, value: int) -> None:
        if event == zmq.EVENT_DISCONNECTED:  # comes after each failed handshake too
            self.num_ended += not self._failed
            self._failed = max(0, self._failed - 1)
            return
        self._failed += 1
        if event == _BROKEN:
            self._refusals.count("handshake", f"a connection breaks the protocol or has other keys (0x{value:08x})")
        elif event == _ENDED:
            self._refusals.count("handshake", f"a connection ended or stayed silent ({errno.errorcode.get(value, 0)})")
