"""Register and look up ports at a name server of YARP, in text.

Protocol: YARP's manual, "The name server protocol" and "YARP without YARP". A connection begins with ``CONNECT who``;
the server says ``Welcome who``. A line ``d`` and a command follow. The answer has one line ``registration name N ip I
port P type C`` for each port, and ends with ``*** end of message``.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

DEFAULT_PORT = 10000
WHO = "skinware"
"""Our name in connections; YARP cuts other connections of one name only if it begins with a slash."""
_END = b"*** end of message"
_REGISTRATION = re.compile(
    rb"registration name (?P<name>\S+) ip (?P<host>\S+) port (?P<port>\d{1,5}) type (?P<carrier>\S+)"
)
_PATIENCE_S = 3.0
_LONGEST_ANSWER = 1 << 16
_LONGEST_NAME = 200


class PortAddress(NamedTuple):
    name: str
    host: str
    port: int
    carrier: str


def is_port_name(name: str) -> bool:
    """Return whether YARP accepts this as the name of a port, and reads it as one word."""
    is_plain = name.isascii() and name.isprintable() and not set(name) & set(" \"'()[]\\")
    return name.startswith("/") and not name.endswith("/") and is_plain and len(name) <= _LONGEST_NAME


def configured_server(environment: Mapping[str, str] = os.environ) -> tuple[str, int]:
    """Return host and port of the name server in ``yarp.conf``, as YARP's programs do; by default on this computer.

    Its folder is ``YARP_CONFIG_HOME``, or ``yarp`` in ``XDG_CONFIG_HOME`` (``~/.config``).
    """
    folder = environment.get("YARP_CONFIG_HOME")
    home = environment.get("XDG_CONFIG_HOME") or Path(environment.get("HOME", "/")) / ".config"
    path = Path(folder) if folder else Path(home) / "yarp"
    try:
        words = (path / "yarp.conf").read_text("utf-8", "replace").split()
    except OSError:
        words = []
    if len(words) >= 2 and words[1].isdecimal() and 0 < int(words[1]) < 1 << 16:
        return words[0], int(words[1])
    return "127.0.0.1", DEFAULT_PORT


class NameServer:
    """A name server. Each call is a connection of its own, and takes at most some seconds."""

    def __init__(self, host: str, port: int = DEFAULT_PORT) -> None:
        self.host = host
        self.port = port

    def __str__(self) -> str:
        return f"YARP's name server at {self.host}:{self.port}"

    def query(self, name: str) -> PortAddress | None:
        """Return the address of a port; None: it is not known. OSError: no name server answers, as in all methods."""
        return self._ask(name, f"query {name}")

    def register(self, name: str, host: str, port: int) -> PortAddress:
        """Register a port in place of any other of that name; host ``...``: the address that the server sees."""
        contact = self._ask(name, f"register {name} tcp {host} {port}")
        if contact is None:
            raise OSError(f"{self} did not register {name}")
        return contact

    def describe(self, name: str, carriers: Collection[str]) -> None:
        """Register the carriers that a port speaks as sender and as receiver, as ports of YARP do."""
        for key in ("offers", "accepts"):
            self._ask(name, f"set {name} {key} {' '.join(carriers)}")

    def unregister(self, name: str) -> None:
        self._ask(name, f"unregister {name}")

    def _ask(self, name: str, command: str) -> PortAddress | None:
        if not is_port_name(name):
            raise ValueError(f"{name!r} is no name of a YARP port: write /name, without spaces")
        until_s = time.monotonic() + _PATIENCE_S
        try:
            with socket.create_connection((self.host, self.port), _PATIENCE_S) as connection:
                connection.sendall(f"CONNECT {WHO}\nd\n{command}\n".encode())
                answer = b""
                while _END not in answer:
                    connection.settimeout(max(0.01, until_s - time.monotonic()))
                    more = connection.recv(4096)
                    if not more or len(answer) > _LONGEST_ANSWER or time.monotonic() > until_s:
                        raise OSError("the answer is not that of a name server")
                    answer += more
        except OSError as error:
            raise OSError(f"{self}: {error.strerror or error}") from None
        for line in answer.splitlines():
            match = _REGISTRATION.fullmatch(line.strip())
            if match is None or not 0 < int(match["port"]) < 1 << 16:
                continue
            about, host, carrier = (match[part].decode("utf-8", "replace") for part in ("name", "host", "carrier"))
            if about == name:
                return PortAddress(name, host, int(match["port"]), carrier)
        return None
