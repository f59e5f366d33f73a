"""Addresses of network buses, and the bases that TCP, UDP and servers share."""

from __future__ import annotations

import os
import socket
from typing import Annotated, Any, ClassVar, NamedTuple
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.bus import FrameBatch
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.serial.stream import CHUNK

Resolved = tuple[socket.AddressFamily, tuple[str, int]]
"""Family, and the first two parts of the address for sockets of that family."""


class Address(NamedTuple):
    """A host and a port.

    Attributes:
        host: name or number; empty: any.
        port: 0 to 65535.
    """

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    def resolve(self, kind: socket.SocketKind) -> Resolved:
        """Look the name up, which may take a while; return the first address.

        Raises:
            BusNotAvailable: the name is not known now.
        """
        flags = 0 if self.host else socket.AI_PASSIVE
        try:
            found = socket.getaddrinfo(self.host or None, self.port, type=kind, flags=flags)
        except socket.gaierror as error:
            raise unknown_name(self, error) from None
        family, *_, numbers = found[0]
        return family, (str(numbers[0]), int(numbers[1]))


def split_url(channel: str) -> str:
    """Return host and port of a URL.

    Raises:
        ConfigurationError: this is no URL of a websocket without encryption.
    """
    parts = urlsplit(channel)
    if parts.scheme != "ws":
        raise ConfigurationError(f"bus websocket:{channel}: write websocket:ws://HOST:PORT (there is no wss)")
    return parts.netloc


def parse_address(scheme: str, channel: str, *, default_port: int | None = None, needs_host: bool = True) -> Address:
    """Parse ``HOST:PORT`` or ``[HOST]:PORT``; an IPv6 address stands in brackets.

    Args:
        scheme: for messages, such as ``tcp``.
        default_port: used if none is given; None: one must be given.
        needs_host: a host must be given, too.

    Raises:
        ConfigurationError: this is no such address.
    """
    try:
        parts = urlsplit(f"//{channel}")
        host, port = parts.hostname or "", parts.port
        if parts.path or parts.query or parts.username is not None:
            raise ValueError("more than host and port")
    except ValueError as error:
        raise ConfigurationError(
            f"bus {scheme}://{channel}: {_mistake(channel) or error}; write {scheme}://HOST:PORT"
        ) from None
    port = default_port if port is None else port
    if port is None or (needs_host and not host):
        raise ConfigurationError(
            f"bus {scheme}://{channel}: which {'port' if host else 'host'}? Write {scheme}://HOST:PORT, such as"
            f" {scheme}://192.168.1.10:5000"
        )
    return Address(host, port)


def unknown_name(address: Address, error: socket.gaierror) -> BusNotAvailable:
    """Return the error for a host whose name is not known now, which can change."""
    return BusNotAvailable(f"the name {address.host!r} of a host is not known ({error.strerror or error})")


def reason_of(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)


def _mistake(channel: str) -> str:
    """Name a usual mistake; empty: it is another one."""
    port = channel.rpartition(":")[2]
    if "&" in channel or "=" in channel:
        return "options begin with a question mark"
    if channel.count(":") > 1 and "[" not in channel:
        return "an IPv6 address stands in brackets"
    if "]" in channel and port.endswith("]"):
        return ""
    if not port.isdecimal() and "/" not in port:
        return f"{port!r} is no port number"
    return "ports have numbers up to 65535" if port.isdecimal() and int(port) > 65535 else ""


class StreamBus(SerialBus):
    """A bus that programs or networks carry, with options of its own.

    Attributes:
        scheme: of its name, ``SCHEME://CHANNEL``.
    """

    scheme: ClassVar[str]
    options_class: ClassVar[type[msgspec.Struct]]

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._options: Any = options_from_strings(self.options_class, options or {})
        self._place: Any = self._parse(channel)

    def _parse(self, channel: str) -> Any:
        """Return the place that the channel names, or raise ConfigurationError."""
        raise NotImplementedError

    @property
    def name(self) -> str:
        return f"bus {self.scheme}:{'' if '://' in self.channel else '//'}{self.channel}"

    @property
    def baudrate(self) -> int:
        """0: a network has no baud rate."""
        return 0


class NetworkBus(StreamBus):
    """A serial bus over a network; its channel is ``HOST:PORT``, and ``needs_host`` says whether HOST may be empty."""

    needs_host: ClassVar[bool] = False

    def _parse(self, channel: str) -> Address:
        return parse_address(self.scheme, channel, needs_host=self.needs_host)


class MessagePort(Port):
    """A port from which Python reads messages.

    Attributes:
        dropped, refused: messages that were not used, since they were counted last.
    """

    dropped = refused = 0


class MessageBus(StreamBus):
    """A bus of messages that Python reads; ``most_messages``: of a take, before other buses get their turn."""

    most_messages: ClassVar[int] = 1

    @property
    def reads_natively(self) -> bool:
        return False

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append the frames of the messages that have arrived, at most ``batch.free``."""
        taken = 0
        for _ in range(self.most_messages):
            bytes_before = self.counters.framing.bytes_in
            try:
                taken += super().receive(batch, ordinal)
            except BusNotAvailable:
                if not taken:
                    raise
                self._stay_readable(True)  # the next take raises it again
                break
            if not batch.free or self.counters.framing.bytes_in == bytes_before:
                break
        return taken

    def _read(self, port: Any) -> None:
        """Read one message, never two as one."""
        try:
            if message := port.read(CHUNK):
                self._hear(message, now_ns())
        finally:
            self._count(port)

    def _count(self, port: MessagePort) -> None:
        self.counters.dropped += port.dropped
        self.counters.refused += port.refused
        port.dropped = port.refused = 0


class ServerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a connection to a program that sends by itself."""

    patience_s: Annotated[
        int, Meta(ge=2, le=600, description="seconds without a sign of the other end until the connection is given up")
    ] = 5
    silence_s: Annotated[
        float, Meta(ge=0, le=3600, description="seconds without a message until it is connected again; 0: never")
    ] = 5.0


class ServerBus(MessageBus):
    """A program that sends by itself, perhaps to others as well, and is only read."""

    options_class: ClassVar[type[msgspec.Struct]] = ServerOptions
    _heard_ns = 0

    def open(self) -> None:
        super().open()
        self._heard_ns = now_ns()

    def check(self) -> None:
        """Check that the other end still sends."""
        super().check()
        silence_s = self._options.silence_s
        if self._port is not None and silence_s and now_ns() - self._heard_ns > silence_s * NS_PER_S:
            raise BusNotAvailable(f"{self.name}: connected, but no message for {silence_s:g} s; connecting again")

    def send(self, identifier: int, payload: bytes) -> None:
        """Refuse to send: it is only read."""
        self.counters.send_failures += 1
        raise BusSendError(f"{self.name} is only read ({identifier:#x}, {len(payload)} bytes)")

    def _hear(self, chunk: bytes, time_ns: int) -> None:
        self._heard_ns = time_ns
        for start in range(0, len(chunk), CHUNK):
            super()._hear(chunk[start : start + CHUNK], time_ns)
