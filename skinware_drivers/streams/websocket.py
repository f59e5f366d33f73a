"""Read a websocket server as a bus: each of its messages is a line of a stream."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from skinware.errors import BusNotAvailable
from skinware.realtime import now_ns
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.serial.ports import Port
from skinware_drivers.streams.bus import ServerBus, need_package, parse_address, split_url

if TYPE_CHECKING:
    from skinware_drivers.streams.websocket_ends import WebSocketPort

log: logging.Logger = logging.getLogger("skinware.driver")

_PACKAGE = "websockets", "websocket"
_HTTP = 80
_MOST_MESSAGES = 256
"""Messages of a take, before other buses get their turn."""


def _device_end(channel: str, options: dict[str, str] | None = None, **more: Any) -> Bus:
    need_package(f"bus websocket:{channel}", *_PACKAGE)
    from skinware_drivers.streams.websocket_ends import WebSocketServerBus

    return WebSocketServerBus(channel, options, **more)


class WebSocketBus(ServerBus):
    """A connection to a websocket server. Its name is ``websocket:ws://HOST:PORT/PATH?key=value``.

    A framing finds frames in its messages. Each gets an end of line, and those within it become spaces. Messages of
    64 KiB and more, and one that breaks off with the connection, are counted as refused. After a server has closed the
    connection, or sent no message for ``silence_s``, it is connected to again after growing pauses.

    Raises:
        ConfigurationError: no such URL, an option is unknown or has a bad value, or the package websockets is missing.
    """

    scheme: ClassVar[str] = "websocket"
    device_end: ClassVar[Callable[..., Bus] | None] = _device_end

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, options, payload_size=payload_size, listen_only=listen_only)
        need_package(self.name, *_PACKAGE)
        self._address = parse_address("ws", split_url(channel), default_port=_HTTP)
        self._web: WebSocketPort | None = None
        self._unusable = 0

    def open(self) -> None:
        """Connect; a message that came with the server's greeting is read at once.

        Raises:
            BusNotAvailable: no websocket server answers there.
        """
        super().open()
        self._stay_readable(self._web is not None and self._web.waiting > 0)

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append the frames of the messages that have arrived, at most ``batch.free``.

        Raises:
            BusNotAvailable: the connection is closed; the message says by which end, and with which code.
        """
        taken, more = 0, True
        for _ in range(_MOST_MESSAGES):
            bytes_before = self.counters.framing.bytes_in
            try:
                taken += super().receive(batch, ordinal)
            except BusNotAvailable:
                self._count_unusable()
                if not taken:
                    raise
                break  # the next take says it again
            more = self.counters.framing.bytes_in != bytes_before
            if not batch.free or not more:
                break
        self._count_unusable()
        self._stay_readable(more or not batch.free)
        return taken

    def _open_port(self) -> Port:
        from skinware_drivers.streams.websocket_ends import WebSocketPort

        self._web = WebSocketPort(self.channel, self._address, self._options.patience_s)
        return self._web

    def _read(self, port: Port) -> None:
        if message := port.read(0):
            self._hear(message, now_ns())

    def _count_unusable(self) -> None:
        if self._web is None or not self._web.unusable:
            return
        self.counters.refused += self._web.unusable
        self._web.unusable = 0
        if not self._unusable:
            log.warning("%s: messages that are too long or broke off are left out (logged once)", self.name)
        self._unusable += 1
