"""Read a stream over a network as a bus: its address, and what TCP, UDP and servers have in common."""

from __future__ import annotations

import os
import socket
from typing import Annotated, ClassVar, NamedTuple
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus

Resolved = tuple[socket.AddressFamily, tuple[str, int]]
"""Family, and the address as sockets of that family know it (the first two parts)."""


class Address(NamedTuple):
    """Where something is.

    Attributes:
        host: name or number; empty: whichever.
        port: 0 to 65535.
    """

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    def resolve(self, kind: socket.SocketKind) -> Resolved:
        """Look its name up, which may take a while; the first address that there is.

        Raises:
            BusNotAvailable: the name is not known now.
        """
        try:
            family, *_, numbers = socket.getaddrinfo(self.host or None, self.port, type=kind, flags=_flags(self.host))[
                0
            ]
        except socket.gaierror as error:
            raise unknown_name(self, error) from None
        return family, (str(numbers[0]), int(numbers[1]))


def parse_address(scheme: str, channel: str, *, default_port: int | None = None, needs_host: bool = True) -> Address:
    """Take ``HOST:PORT`` or ``[HOST]:PORT`` apart; an IPv6 address stands in brackets.

    Args:
        scheme: for messages, such as ``tcp``.
        channel: of the bus' name.
        default_port: where none is given; None: one must be.
        needs_host: whether the host must be given, too.

    Raises:
        ConfigurationError: it is no such address.
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
    """Nobody knows this host now; that can change."""
    return BusNotAvailable(f"the name {address.host!r} of a host is not known ({error.strerror or error})")


def reason_of(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)


def _mistake(channel: str) -> str:
    """Those that are usual, in words; empty: another one."""
    port = channel.rpartition(":")[2]
    if "&" in channel or "=" in channel:
        return "options begin with a question mark"
    if channel.count(":") > 1 and "[" not in channel:
        return "an IPv6 address stands in brackets"
    if "]" in channel and port.endswith("]"):
        return ""
    if not port.isdecimal() and "/" not in port:
        return f"{port!r} is no number of a port"
    return "ports have numbers up to 65535" if port.isdecimal() and int(port) > 65535 else ""


def _flags(host: str) -> int:
    return 0 if host else socket.AI_PASSIVE


class NetworkBus(SerialBus):
    """A serial bus that is reached over a network.

    Args:
        channel: ``HOST:PORT``.
        payload_size: longest body that fits into a batch.
        listen_only: refuse every ``send``.

    Raises:
        ConfigurationError: no such address.
    """

    scheme: ClassVar[str]
    needs_host: ClassVar[bool] = False

    def __init__(self, channel: str, *, payload_size: int, listen_only: bool) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._address: Address = parse_address(self.scheme, channel, needs_host=self.needs_host)

    @property
    def name(self) -> str:
        return f"bus {self.scheme}://{self.channel}"

    @property
    def baudrate(self) -> int:
        """0: a network has none."""
        return 0


class ServerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a bus that is a connection to a program that sends by itself."""

    patience_s: Annotated[
        int, Meta(ge=2, le=600, description="seconds without a sign of the other end until the connection is given up")
    ] = 5
    silence_s: Annotated[
        float, Meta(ge=0, le=3600, description="seconds without a message until it is connected anew; 0: never")
    ] = 5.0


class ServerBus(SerialBus):
    """A program that sends by itself, perhaps to others as well, and is only read.

    Args:
        channel: what the bus' name has after the interface.
        options: see :class:`ServerOptions`.
        payload_size: longest body that fits into a batch.
        listen_only: makes no difference: nothing is ever sent.

    Raises:
        ConfigurationError: an option is unknown or has a bad value.
    """

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._options = options_from_strings(ServerOptions, options or {})
        self._heard_ns = 0

    @property
    def baudrate(self) -> int:
        """0: a network has none."""
        return 0

    @property
    def reads_natively(self) -> bool:
        """No: the protocol is spoken in Python."""
        return False

    def open(self) -> None:
        """Connect.

        Raises:
            BusNotAvailable: nobody answers there, or somebody else does.
        """
        super().open()
        self._heard_ns = now_ns()

    def check(self) -> None:
        """Whether the other end still says something.

        Raises:
            BusNotAvailable: it has not for too long.
        """
        super().check()
        silence_s = self._options.silence_s
        if self._port is not None and silence_s and now_ns() - self._heard_ns > silence_s * NS_PER_S:
            raise BusNotAvailable(f"{self.name}: connected, but no message for {silence_s:g} s; connecting anew")

    def send(self, identifier: int, payload: bytes) -> None:
        """Refuse: it is only read.

        Raises:
            BusSendError: always.
        """
        self.counters.send_failures += 1
        raise BusSendError(f"{self.name} is only read ({identifier:#x}, {len(payload)} bytes)")

    def _hear(self, chunk: bytes, time_ns: int) -> None:
        self._heard_ns = time_ns
        super()._hear(chunk, time_ns)
