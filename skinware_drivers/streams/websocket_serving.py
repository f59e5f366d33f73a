"""The device's end of a websocket, for emulators: a server that sends lines as messages, to one caller at a time."""

from __future__ import annotations

import socket
from typing import ClassVar

from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol

from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.streams.bus import Address, ServerOptions, parse_address
from skinware_drivers.streams.tcp import ListeningPort
from skinware_drivers.streams.websocket import split_url

_MOST_UNSENT = 1 << 20
"""Bytes that a caller may be behind; what is sent to one that is further behind is for nobody."""


class ServingPort(Port):
    """Each line that is written is a message. What callers say is not heard.

    Args:
        address: at which it listens; port 0: any that is free, which ``note`` tells.
        patience_s: seconds without a sign of the caller until it is given up.

    Raises:
        BusNotAvailable: it cannot listen there.
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
        """Answer the caller's greeting, and its goodbye; gives nothing."""
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


class WebSocketServerBus(SerialBus):
    """``skin-emulate --bus websocket:ws://HOST:PORT``; ``note`` tells where it listens.

    Raises:
        ConfigurationError: no such URL, or an option is unknown or has a bad value.
    """

    scheme: ClassVar[str] = "ws"

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._options = options_from_strings(ServerOptions, options or {})
        self._address = parse_address(self.scheme, split_url(channel), needs_host=False)

    @property
    def name(self) -> str:
        return f"bus websocket:{self.channel}"

    def _open_port(self) -> Port:
        return ServingPort(self._address, self._options.patience_s)
