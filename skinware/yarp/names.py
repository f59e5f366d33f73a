"""A YARP name server, asked in text: where a port is, and that there is one.

Protocol: YARP's manual, "The name server protocol" and "YARP without YARP". A connection begins with ``CONNECT who``,
to which the server says ``Welcome who``. A line ``d`` and a command follow; the answer is lines up to
``*** end of message``, of which ``registration name N ip I port P type C`` is one for each port.
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
"""What we are called in connections; YARP cuts others of the same name only where it begins with a slash."""
_END = b"*** end of message"
_REGISTRATION = re.compile(
    rb"registration name (?P<name>\S+) ip (?P<host>\S+) port (?P<port>\d{1,5}) type (?P<carrier>\S+)"
)
_PATIENCE_S = 3.0
_LONGEST_ANSWER = 1 << 16
_LONGEST_NAME = 200


class Contact(NamedTuple):
    """How a port is reached.

    Attributes:
        name: of the port.
        host: name or number.
        port: of TCP, 1 to 65535.
        carrier: with which a connection begins; ``tcp`` for all ports that speak with everybody.
    """

    name: str
    host: str
    port: int
    carrier: str


def is_port_name(name: str) -> bool:
    """Whether YARP takes this as a port's name; one that could be taken for more than one word is none."""
    is_plain = name.isascii() and name.isprintable() and not set(name) & set(" \"'()[]\\")
    return name.startswith("/") and not name.endswith("/") and is_plain and len(name) <= _LONGEST_NAME


def configured_server(environment: Mapping[str, str] = os.environ) -> tuple[str, int]:
    """Where YARP's own programs look for the name server: in ``yarp.conf``; this computer, unless it says another.

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
    """A name server. Each call is a connection of its own, and takes at most some seconds.

    Args:
        host: name or number.
        port: of TCP.
    """

    def __init__(self, host: str, port: int = DEFAULT_PORT) -> None:
        self.host = host
        self.port = port

    def __str__(self) -> str:
        return f"YARP's name server at {self.host}:{self.port}"

    def query(self, name: str) -> Contact | None:
        """Where a port is; None: there is none of that name.

        Raises:
            OSError: it does not answer, or what answers is no name server; the same for the others.
            ValueError: no port can have this name; the same for the others.
        """
        return self._ask(name, f"query {name}")

    def register(self, name: str, host: str, port: int) -> Contact:
        """Tell that there is a port; what was known of one of that name is forgotten.

        Args:
            name: of the port.
            host: how others reach it; ``...``: as the server sees us.
            port: of TCP.
        """
        told = self._ask(name, f"register {name} tcp {host} {port}")
        if told is None:
            raise OSError(f"{self} did not take {name}")
        return told

    def describe(self, name: str, carriers: Collection[str]) -> None:
        """Have the server keep in which carriers a port can be called, as ports of YARP do when they register.

        Args:
            name: of the port, which is registered.
            carriers: that it speaks as sender and as receiver.
        """
        for key in ("offers", "accepts"):
            self._ask(name, f"set {name} {key} {' '.join(carriers)}")

    def unregister(self, name: str) -> None:
        self._ask(name, f"unregister {name}")

    def _ask(self, name: str, command: str) -> Contact | None:
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
                        raise OSError("what answers there is no name server")
                    answer += more
        except OSError as error:
            raise OSError(f"{self}: {error.strerror or error}") from None
        found = [contact for line in answer.splitlines() if (contact := _contact(line)) and contact.name == name]
        return found[0] if found else None


def _contact(line: bytes) -> Contact | None:
    """What a line of an answer says of a port; None if it says nothing of any."""
    match = _REGISTRATION.fullmatch(line.strip())
    if match is None or not 0 < int(match["port"]) < 1 << 16:
        return None
    name, host, carrier = (match[part].decode("utf-8", "replace") for part in ("name", "host", "carrier"))
    return Contact(name, host, int(match["port"]), carrier)
