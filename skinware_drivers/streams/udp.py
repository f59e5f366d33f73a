"""Datagrams as a bus: each is a frame, or holds frames that a framing of serial lines finds.

Only one other end is heard, which its address identifies. The network may lose and reorder datagrams; where a protocol
numbers its frames and the layout says so, missing ones are counted, and overtaken ones are not shown.
"""

from __future__ import annotations

import os
import socket
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.serial.ports import Port
from skinware_drivers.streams.bus import Address, MessageBus, MessagePort, NetworkBus

_RECEIVE_BUFFER = 1 << 20
_SILENT_NS = 2 * NS_PER_S
_ANY_HOST = {socket.AF_INET: "0.0.0.0", socket.AF_INET6: "::"}


class UdpOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    local: Annotated[
        Annotated[int, Meta(ge=1, le=65535)] | None,
        Meta(description="port of this computer, for devices that send to a fixed one; default: any that is free"),
    ] = None


class UdpPort(MessagePort):
    """A socket for datagrams, and the one other end that is heard.

    Args:
        address: with a host: of the other end; without: the port of this computer.
        local: port of this computer, if the other end is given.

    Attributes:
        refused: datagrams of other senders.
        peer: the other end; None: none has sent yet.
    """

    longest_wait = 0

    def __init__(self, address: Address, local: int | None = None) -> None:
        self.peer: tuple[str, int] | None = None
        self._may_change = not address.host
        self._heard_ns = -_SILENT_NS
        family = socket.AF_INET
        if address.host:
            family, self.peer = address.resolve(socket.SOCK_DGRAM)
        port = (local or 0) if address.host else address.port
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        try:
            self._socket.bind((_ANY_HOST[family], port))
        except OSError as error:
            self._socket.close()
            raise BusNotAvailable(f"udp port {port} of this computer: {error.strerror or error}") from None
        if not address.host and not port:
            self.note = f"port {self._socket.getsockname()[1]} of this computer"

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self, size: int) -> bytes:
        """Return the next datagram of the other end, or nothing; empty ones do not count."""
        while True:
            try:
                data, sender = self._socket.recvfrom(size)
            except BlockingIOError:
                return b""
            except OSError as error:
                raise BusNotAvailable(f"udp: {os.strerror(error.errno or 0)}") from None
            if not self._is_heard(sender[:2]):
                self.refused += 1
            elif data:
                return data

    def write(self, data: bytes) -> int:
        """Send one datagram; drop it while no other end is known."""
        if self.peer is None:
            return len(data)
        try:
            return self._socket.sendto(data, self.peer)
        except BlockingIOError:
            return 0
        except ConnectionRefusedError:  # the answer to an earlier datagram
            return self._socket.sendto(data, self.peer)

    def close(self) -> None:
        self._socket.close()

    def _is_heard(self, sender: tuple[str, int]) -> bool:
        """Return whether a sender is the other end: as given, or the first to send, until it is silent for 2 s."""
        time_ns = now_ns()
        if self._may_change and sender != self.peer and time_ns - self._heard_ns > _SILENT_NS:
            self.peer = sender
        if sender == self.peer:
            self._heard_ns = time_ns
        return sender == self.peer


class UdpBus(MessageBus, NetworkBus):
    """Datagrams to and from one other end. Its name is ``udp://HOST:PORT`` or ``udp://:PORT``, with ``?key=value``.

    With a host, datagrams go to that host and port, and only its datagrams are received. Without one, PORT is that of
    this computer, and the first sender is the other end. Datagrams of other senders are counted as refused.

    A framing finds frames in the joined content of the datagrams, as converters of serial lines send it. With
    ``Unframed``, each datagram is a frame.
    """

    scheme: ClassVar[str] = "udp"
    options_class: ClassVar[type[msgspec.Struct]] = UdpOptions
    most_messages: ClassVar[int] = 512

    def _parse(self, channel: str) -> Address:
        address = super()._parse(channel)
        if self._options.local and not address.host:
            raise ConfigurationError(f"{self.name}: its port is that of this computer already; leave local out")
        return address

    def _open_port(self) -> Port:
        return UdpPort(self._place, self._options.local)
