"""A YARP name server that knows one port, and that port: the end of emulated devices.

The name server is asked in text, as real ones can be. The port is read in a binary carrier only: real ports of vectors
die of a reader in text, so this one hangs up.
"""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Callable

from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.streams.bus import Address, ServerOptions
from skinware_drivers.streams.tcp import ListeningPort
from skinware_drivers.streams.yarp_bus import split_channel

_END = b"*** end of message\r\n"
_MESSAGE = bytes.fromhex("59410A0000005250")
_READ = bytes.fromhex("7E720001")
_HEAD_OF_MESSAGE, _HEAD_OF_GREETING = 30, 12
_MOST_HEARD = 1 << 12
_MOST_UNSENT = 1 << 20
"""Bytes that a reader may be behind; what is sent to one that is further behind is for nobody."""


class _Conversation:
    """What a caller has said so far; begins again with each caller."""

    def __init__(self, line: ListeningPort) -> None:
        self.line = line
        self.unsent = b""
        self._caller: socket.socket | None = None
        self._heard = b""

    def lines(self) -> list[bytes]:
        *lines, self._heard = self._hear().split(b"\n")
        return [line.strip() for line in lines]

    def parts(self, sizes: Callable[[bytes], int]) -> list[bytes]:
        """The binary parts that have come; ``sizes`` gives how many bytes the next one has."""
        heard, found = self._hear(), []
        while heard and len(heard) >= (size := sizes(heard)) > 0:
            found.append(heard[:size])
            heard = heard[size:]
        self._heard = heard
        return found

    def _hear(self) -> bytes:
        data = self.line.read(_MOST_HEARD)
        if self.line.caller is not self._caller:
            self._caller, self._heard, self.unsent = self.line.caller, b"", b""
        return (self._heard + data)[-_MOST_HEARD:]

    def say(self, data: bytes) -> None:
        """As far as the caller takes it; the rest waits."""
        self.unsent += data
        self.unsent = self.unsent[self.line.write(self.unsent) :]


class ServedPort(Port):
    """Both; what is written goes to who reads the port.

    Args:
        address: of the name server; port 0: any that is free, which ``note`` tells.
        name: of the port, which listens at the same host.
        patience_s: seconds without a sign of a caller until it is given up.

    Raises:
        BusNotAvailable: it cannot listen there.
    """

    def __init__(self, address: Address, name: str, patience_s: int) -> None:
        self._name = name
        self._server = _Conversation(ListeningPort(address, patience_s))
        with contextlib.ExitStack() as undo:
            undo.callback(self._server.line.close)
            self._port = _Conversation(ListeningPort(Address(self._server.line.address.host, 0), patience_s))
            undo.pop_all()
        self._epoll = select.epoll()
        for each in (self._server, self._port):
            self._epoll.register(each.line.fileno(), select.EPOLLIN)
        self._is_asked = self._is_read = False
        self._reader: socket.socket | None = None
        self.note = f"listens on {self._server.line.address}"

    def fileno(self) -> int:
        return self._epoll.fileno()

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Answer; gives nothing."""
        for line in self._server.lines():
            self._answer_question(line)
        for part in self._port.parts(_size):
            self._answer_reader(part)
        self._server.say(b"")
        self._forget_reader()
        self._port.say(b"")
        return b""

    def write(self, data: bytes) -> int:
        self._forget_reader()
        if self._is_read and len(self._port.unsent) < _MOST_UNSENT:
            self._port.say(data)
        return len(data)

    def close(self) -> None:
        self._epoll.close()
        self._server.line.close()
        self._port.line.close()

    def _answer_question(self, line: bytes) -> None:
        address = self._port.line.address
        told = f"registration name {self._name} ip {address.host} port {address.port} type tcp\r\n".encode()
        if line.startswith(b"CONNECT "):
            self._server.say(b"Welcome " + line[8:] + b"\r\n")
        elif line in (b"d", b"do"):
            self._is_asked = True
        elif self._is_asked:
            self._is_asked = False
            self._server.say((told if line == b"query " + self._name.encode() else b"") + _END)

    def _answer_reader(self, part: bytes) -> None:
        if part.startswith(_MESSAGE):
            self._is_read, self._reader = part.endswith(_READ), self._port.line.caller
        elif part[:2] == b"YA":
            self._port.say(b"YA" + self._port.line.address.port.to_bytes(4, "little") + b"RP")
        elif self._port.line.caller is not None:
            self._port.line.caller.shutdown(socket.SHUT_RDWR)

    def _forget_reader(self) -> None:
        if self._port.line.caller is not self._reader:
            self._is_read, self._reader = False, self._port.line.caller


def _size(heard: bytes) -> int:
    """How many bytes the greeting or message that begins here has; text is given line by line, to be refused."""
    if not heard.startswith(b"YA"[: len(heard)]):
        return heard.find(b"\n") + 1
    if heard.startswith(_MESSAGE) and len(heard) >= _HEAD_OF_MESSAGE:
        return _HEAD_OF_MESSAGE - 4 + int.from_bytes(heard[18:22], "little")
    if not heard.startswith(_MESSAGE) and len(heard) >= _HEAD_OF_GREETING:
        return _HEAD_OF_GREETING + int.from_bytes(heard[8:12], "little")
    return _MOST_HEARD


class YarpServerBus(SerialBus):
    """``skin-emulate --bus yarp://HOST:PORT/NAME``; ``note`` tells where the name server listens.

    Raises:
        ConfigurationError: no such name, or an option is unknown or has a bad value.
    """

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only)
        self._options = options_from_strings(ServerOptions, options or {})
        server, self._port_name = split_channel(channel)
        self._address = server or Address("127.0.0.1", 0)

    @property
    def name(self) -> str:
        return f"bus yarp://{self.channel}"

    def _open_port(self) -> Port:
        return ServedPort(self._address, self._port_name, self._options.patience_s)
