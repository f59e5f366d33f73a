"""Read a websocket server as a bus, each of its messages as a line of a stream; and serve lines, for emulators.

The package websockets speaks the protocol.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import time
from collections import deque
from collections.abc import Callable
from importlib.util import find_spec
from typing import ClassVar

import msgspec

from skinware.errors import BusNotAvailable, MissingExtra
from skinware.status import BusReason
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.serial.ports import Port
from skinware_drivers.serial.stream import CHUNK
from skinware_drivers.streams.bus import (
    Address,
    MessagePort,
    NetworkBus,
    ServerBus,
    ServerOptions,
    parse_address,
    split_url,
)
from skinware_drivers.streams.tcp import ListeningPort, connect, keep_alive

if find_spec("websockets") is None:
    raise MissingExtra.of("a bus websocket", "skinware[websocket]")

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidURI
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

log: logging.Logger = logging.getLogger("skinware.driver")

_HTTP = 80
LONGEST = CHUNK - 1
"""Bytes of the longest message that is used."""
_MOST = 1 << 20
"""Bytes of a message at which the connection is given up."""
_GREETING_S = 5.0
_MOST_UNSENT = 1 << 20
"""Bytes that a caller may be behind; more are dropped."""
_HELD_UP = "; it failed, or this computer was held up and answered its pings too late"


class WebSocketPort(MessagePort):
    """The client's end: reads messages, and sends nothing but the protocol's own answers.

    Args:
        url: ``ws://HOST:PORT/PATH``.
        patience_s: seconds without a sign of the other end until it is given up.

    Attributes:
        refused: messages that were too long, or broke off.
    """

    longest_wait = 0

    def __init__(self, url: str, address: Address, patience_s: int) -> None:
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
        """Return the socket's descriptor, which is not readable merely because messages wait."""
        return self._socket.fileno()

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return the next message as one line, or nothing."""
        if not self._messages:
            self._listen()
        return self._messages.popleft() if self._messages else b""

    def write(self, data: bytes) -> int:
        raise OSError(f"{self._url} is only read ({len(data)} bytes)")

    def close(self) -> None:
        """Close the connection in the protocol's way, then the socket."""
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
            self.refused += 1
        else:
            self._messages.append(message.replace(b"\n", b" ") + b"\n")

    def _answer(self) -> None:
        """Send the protocol's own bytes: the handshake, and answers to pings and to a close."""
        for data in self._protocol.data_to_send():
            with contextlib.suppress(OSError):  # the next read raises it
                if data:
                    self._socket.sendall(data)
                else:
                    self._socket.shutdown(socket.SHUT_WR)

    def _closed(self) -> BusNotAvailable:
        """Return why the connection is closed; half a message counts as unusable."""
        self.refused += bool(self._parts)
        self._parts = []
        received, sent = self._protocol.close_rcvd, self._protocol.close_sent
        if received is not None:
            why = _HELD_UP if received.code == CloseCode.INTERNAL_ERROR else ""
            return BusNotAvailable(f"{self._url}: the server has closed the connection: {received}{why}")
        if sent is not None:
            self.refused += sent.code == CloseCode.MESSAGE_TOO_BIG
            return BusNotAvailable(f"{self._url}: gave the connection up: {sent}", reason=BusReason.FAILED)
        return BusNotAvailable(f"{self._url}: the connection was closed without a word")

    def _lost(self, error: OSError) -> BusNotAvailable:
        self.refused += bool(self._parts)
        self._parts = []
        return BusNotAvailable(f"{self._url}: the connection is lost ({error.strerror or error})")


class ServingPort(Port):
    """The server's end: sends each line that is written as a message, and ignores messages of its caller.

    Args:
        address: at which to listen; port 0: any that is free, which ``note`` shows.
        patience_s: seconds without a sign of the caller until it is given up.
    """

    def __init__(self, address: Address, patience_s: int) -> None:
        self._line = ListeningPort(address, patience_s)
        self._protocol = ServerProtocol()
        self._caller: socket.socket | None = None
        self._unsent = b""
        self.note = self._line.note

    def fileno(self) -> int:
        return self._line.fileno()

    def read(self, size: int) -> bytes:
        """Answer the handshake and the close of the caller; return nothing."""
        data = self._line.read(size)
        if self._line.caller is not self._caller:
            self._caller = self._line.caller
            self._protocol, self._unsent = ServerProtocol(), b""
        if data:
            self._protocol.receive_data(data)
            for event in self._protocol.events_received():
                if isinstance(event, Request):
                    self._protocol.send_response(self._protocol.accept(event))
        self._send()
        return b""

    def write(self, data: bytes) -> int:
        if self._protocol.state is State.OPEN and self._line.caller is not None and len(self._unsent) < _MOST_UNSENT:
            for line in data.splitlines():
                self._protocol.send_text(line)
        self._send()
        return len(data)

    def close(self) -> None:
        self._line.close()

    def _send(self) -> None:
        self._unsent += b"".join(self._protocol.data_to_send())
        if self._unsent:
            self._unsent = self._unsent[self._line.write(self._unsent) :]


class WebSocketServerBus(NetworkBus):
    """The device's end, for emulators: ``skin-emulate --bus websocket:ws://HOST:PORT``. ``note`` shows the address."""

    scheme: ClassVar[str] = "websocket"
    options_class: ClassVar[type[msgspec.Struct]] = ServerOptions

    def _parse(self, channel: str) -> Address:
        return parse_address("ws", split_url(channel), needs_host=False)

    def _open_port(self) -> Port:
        return ServingPort(self._place, self._options.patience_s)


class WebSocketBus(ServerBus):
    """A connection to a websocket server. Its name is ``websocket:ws://HOST:PORT/PATH?key=value``.

    A framing finds frames in its messages. Each gets an end of line, and those within it become spaces. Messages of
    64 KiB and more, and one that breaks off with the connection, are counted as refused. After a server has closed the
    connection, or sent no message for ``silence_s``, it is connected to again after growing pauses.
    """

    scheme: ClassVar[str] = "websocket"
    device_end: ClassVar[Callable[..., Bus] | None] = WebSocketServerBus
    most_messages: ClassVar[int] = 256
    _web: WebSocketPort | None = None
    _has_warned = False

    def _parse(self, channel: str) -> Address:
        return parse_address("ws", split_url(channel), default_port=_HTTP)

    def open(self) -> None:
        """Connect; a message that came with the server's greeting is read at once."""
        super().open()
        self._read_on()

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        taken = super().receive(batch, ordinal)
        self._read_on()
        return taken

    def _read_on(self) -> None:
        """Wake up again for messages that wait in the port, which is not readable for them."""
        if self._web is not None and self._web.waiting:
            self._stay_readable(True)

    def _open_port(self) -> Port:
        self._web = WebSocketPort(self.channel, self._place, self._options.patience_s)
        return self._web

    def _count(self, port: MessagePort) -> None:
        if port.refused and not self._has_warned:
            self._has_warned = True
            log.warning("%s: messages that are too long or broke off are left out (logged once)", self.name)
        super()._count(port)
