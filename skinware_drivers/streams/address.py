"""Host and port of a bus that is reached over a network."""

from __future__ import annotations

import os
import socket
from typing import NamedTuple
from urllib.parse import urlsplit

from skinware.errors import BusNotAvailable, ConfigurationError

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
