"""A connection to a websocket server: its messages, one line each. The protocol is that of the package websockets."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import deque

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidURI
from websockets.frames import CloseCode, Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from skinware.errors import BusNotAvailable
from skinware.status import BusReason
from skinware_drivers.serial.ports import Port
from skinware_drivers.serial.stream import CHUNK
from skinware_drivers.streams.bus import Address
from skinware_drivers.streams.tcp import connect, keep_alive

LONGEST = CHUNK - 1
"""Bytes of a message; what is longer is left out."""
_MOST = 1 << 20
"""Bytes of a message at which the connection is given up."""
_GREETING_S = 5.0
_HELD_UP = "; it failed, or this computer was held up and answered its pings too late"


class WebSocketPort(Port):
    """Reads messages. What it writes are the protocol's own answers; nothing else can be sent.

    Args:
        url: ``ws://HOST:PORT/PATH``.
        address: host and port of it.
        patience_s: seconds without a sign of the other end until it is given up.

    Attributes:
        unusable: messages that were too long, or broke off.

    Raises:
        BusNotAvailable: nobody answers there, or no websocket server.
    """

    longest_wait = 0

    def __init__(self, url: str, address: Address, patience_s: int) -> None:
        self.unusable = 0
        self._url = url
        self._messages: deque[bytes] = deque()
        self._parts: list[bytes] = []
        try:
            self._protocol = ClientProtocol(parse_uri(url), max_size=_MOST)
        except InvalidURI as error:
            raise BusNotAvailable(f"{url}: {error}", reason=BusReason.FAILED) from None
        self._socket = connect(address)
        try:
            keep_alive(self._socket, patience_s)
            self._greet()
            self._socket.setblocking(False)
        except BaseException:
            self._socket.close()
            raise

    @property
    def waiting(self) -> int:
        return len(self._messages)

    def fileno(self) -> int:
        """The socket's descriptor; not readable because of messages that wait."""
        return self._socket.fileno()

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """The next message, with an end of line in place of any within it; none if there is none.

        Raises:
            BusNotAvailable: the connection is closed; the message says by whom, and with which code.
        """
        if not self._messages:
            self._listen()
        return self._messages.popleft() if self._messages else b""

    def write(self, data: bytes) -> int:
        raise OSError(f"{self._url} is only read ({len(data)} bytes)")

    def close(self) -> None:
        """Say goodbye, and let go of the socket."""
        if self._socket.fileno() >= 0 and self._protocol.state is State.OPEN:
            self._protocol.send_close(CloseCode.NORMAL_CLOSURE)
            self._answer()
        self._socket.close()

    def _greet(self) -> None:
        protocol, deadline_s = self._protocol, time.monotonic() + _GREETING_S
        protocol.send_request(protocol.connect())
        try:
            while True:
                self._answer()
                if protocol.state is not State.CONNECTING or protocol.handshake_exc is not None:
                    break
                self._socket.settimeout(max(0.01, deadline_s - time.monotonic()))
                self._hear(self._socket.recv(CHUNK))
        except TimeoutError:
            raise BusNotAvailable(f"{self._url}: no answer to the websocket handshake") from None
        except OSError as error:
            raise self._lost(error) from None
        if protocol.handshake_exc is not None:
            raise BusNotAvailable(
                f"{self._url}: no websocket server answers there ({protocol.handshake_exc})", reason=BusReason.FAILED
            )

    def _listen(self) -> None:
        if self._protocol.state is not State.OPEN:
            raise self._closed()
        try:
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return
        except OSError as error:
            raise self._lost(error) from None
        self._hear(data)
        self._answer()
        if self._protocol.state is not State.OPEN and not self._messages:
            raise self._closed()

    def _hear(self, data: bytes) -> None:
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._parts.append(bytes(event.data))
                if event.fin:
                    self._take(b"".join(self._parts))
                    self._parts = []

    def _take(self, message: bytes) -> None:
        if len(message) > LONGEST:
            self.unusable += 1
        else:
            self._messages.append(message.replace(b"\n", b" ") + b"\n")

    def _answer(self) -> None:
        """Send what the protocol has to say: its handshake, and answers to pings and to a goodbye."""
        for data in self._protocol.data_to_send():
            with contextlib.suppress(OSError):  # which the next read says
                if data:
                    self._socket.sendall(data)
                else:
                    self._socket.shutdown(socket.SHUT_WR)

    def _closed(self) -> BusNotAvailable:
        """Why the connection is no more; half a message is none."""
        self.unusable += bool(self._parts)
        self._parts = []
        received, sent = self._protocol.close_rcvd, self._protocol.close_sent
        if received is not None:
            why = _HELD_UP if received.code == CloseCode.INTERNAL_ERROR else ""
            return BusNotAvailable(f"{self._url}: the server has closed the connection: {received}{why}")
        if sent is not None:
            self.unusable += sent.code == CloseCode.MESSAGE_TOO_BIG
            return BusNotAvailable(f"{self._url}: gave the connection up: {sent}", reason=BusReason.FAILED)
        return BusNotAvailable(f"{self._url}: the connection was closed without a word")

    def _lost(self, error: OSError) -> BusNotAvailable:
        self.unusable += bool(self._parts)
        self._parts = []
        return BusNotAvailable(f"{self._url}: the connection is lost ({error.strerror or error})")
