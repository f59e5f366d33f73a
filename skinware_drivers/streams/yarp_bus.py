"""Read a port of a robot that runs YARP as a bus: found by its name, read in the carrier ``fast_tcp``; and serve one.

A port never waits for its readers. Each turn of the loop reads everything that has come. If so much has piled up that
this machine must have been held up, only its newest message is used, and the others are counted as dropped.
"""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Callable
from typing import ClassVar

import msgspec

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.status import BusReason
from skinware.yarp.carriers import READ, Carrier, unframed
from skinware.yarp.names import DEFAULT_PORT, WHO, NameServer, configured_server, is_port_name
from skinware_drivers.bus import Bus
from skinware_drivers.serial.framing import begun
from skinware_drivers.serial.ports import Port
from skinware_drivers.serial.stream import CHUNK
from skinware_drivers.streams.bus import Address, MessagePort, ServerBus, ServerOptions, StreamBus, parse_address
from skinware_drivers.streams.tcp import ListeningPort, TcpPort, connect
from skinware_drivers.streams.yarp_messages import BEGIN, message_size

_ROOM = 1 << 20
"""Receive buffer for messages that come while this machine is held up."""
_PILE = 1 << 20
_MOST_PILES = 8
_GREETING_S = 3.0
_ANSWER = 8
_CARRIERS = ("tcp", "fast_tcp", "text", "text_ack")
"""Carriers of ports that can be called by TCP."""

_END_OF_ANSWER = b"*** end of message\r\n"
_MESSAGE = bytes.fromhex("59410A0000005250")
_READ = bytes.fromhex("7E720001")
_HEAD_OF_MESSAGE, _HEAD_OF_GREETING = 30, 12
_MOST_HEARD = 1 << 12
_MOST_UNSENT = 1 << 20
"""Bytes that a reader may be behind; more are dropped."""


def split_channel(channel: str) -> tuple[Address | None, str]:
    """Return name server (None if not given) and port name of ``HOST:PORT/NAME``.

    Raises:
        ConfigurationError: this is no such name.
    """
    place, slash, name = channel.partition("/")
    if not is_port_name(slash + name):
        raise ConfigurationError(
            f"bus yarp://{channel}: which port? Write yarp://HOST:PORT/NAME with the name server's host and port, as"
            " yarp://192.168.1.10:10000/icub/skin/left_hand_comp, or yarp:///NAME"
        )
    return parse_address("yarp", place, default_port=DEFAULT_PORT) if place else None, slash + name


class _Caller:
    """The bytes from and to the present caller at an address."""

    def __init__(self, line: ListeningPort) -> None:
        self.line = line
        self.unsent = b""
        self._caller: socket.socket | None = None
        self._heard = b""

    def lines(self) -> list[bytes]:
        *lines, self._heard = self._hear().split(b"\n")
        return [line.strip() for line in lines]

    def parts(self, sizes: Callable[[bytes], int]) -> list[bytes]:
        """Return the binary parts that have come; ``sizes`` returns the number of bytes of the next one."""
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
        """Send as much as the caller takes; the rest waits."""
        self.unsent += data
        self.unsent = self.unsent[self.line.write(self.unsent) :]


class ServedPort(Port):
    """A name server that knows one port, and that port, for emulators: its reader gets the bytes that are written.

    The name server is asked in text, as real ones can be. The port is read in a binary carrier only: real ports of
    vectors die of a reader in text, so this one hangs up.

    Args:
        address: of the name server; port 0: any that is free, which ``note`` shows.
        name: of the port, which listens at the same host.
        patience_s: seconds without a sign of a caller until it is given up.
    """

    def __init__(self, address: Address, name: str, patience_s: int) -> None:
        self._name = name
        self._server = _Caller(ListeningPort(address, patience_s))
        with contextlib.ExitStack() as undo:
            undo.callback(self._server.line.close)
            self._port = _Caller(ListeningPort(Address(self._server.line.address.host, 0), patience_s))
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
        """Answer both; return nothing."""
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
        contact = f"registration name {self._name} ip {address.host} port {address.port} type tcp\r\n".encode()
        if line.startswith(b"CONNECT "):
            self._server.say(b"Welcome " + line[8:] + b"\r\n")
        elif line in (b"d", b"do"):
            self._is_asked = True
        elif self._is_asked:
            self._is_asked = False
            self._server.say((contact if line == b"query " + self._name.encode() else b"") + _END_OF_ANSWER)

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
    """Return the bytes of the greeting or message that begins here; or of a line of text, which is refused."""
    if not heard.startswith(b"YA"[: len(heard)]):
        return heard.find(b"\n") + 1
    if heard.startswith(_MESSAGE) and len(heard) >= _HEAD_OF_MESSAGE:
        return _HEAD_OF_MESSAGE - 4 + int.from_bytes(heard[18:22], "little")
    if not heard.startswith(_MESSAGE) and len(heard) >= _HEAD_OF_GREETING:
        return _HEAD_OF_GREETING + int.from_bytes(heard[8:12], "little")
    return _MOST_HEARD


class YarpServerBus(StreamBus):
    """The device's end, for emulators: ``skin-emulate --bus yarp://HOST:PORT/NAME``. ``note`` shows the name server."""

    scheme: ClassVar[str] = "yarp"
    options_class: ClassVar[type[msgspec.Struct]] = ServerOptions

    def _parse(self, channel: str) -> tuple[Address | None, str]:
        return split_channel(channel)

    def _open_port(self) -> Port:
        address, name = self._place
        return ServedPort(address or Address("127.0.0.1", 0), name, self._options.patience_s)


class YarpPort(MessagePort, TcpPort):
    """A connection to a port that sends its messages to us; it reads whole messages.

    It uses the carrier ``fast_tcp``, never ``text``: a real port that sends vectors writes past a buffer when it is
    read in text, and its program dies (YARP 2.3.64 to 4.0.0, ``BufferedConnectionWriter``).

    Attributes:
        dropped: messages that were not used, because newer ones had come.
    """

    def __init__(self, name: str, address: Address, patience_s: int) -> None:
        connection = connect(address)
        try:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM)
            _begin_reading(connection, name)
            super().__init__(name, connection, patience_s)
        except OSError as error:
            connection.close()
            raise BusNotAvailable(f"{name}: the port has hung up ({error.strerror or error})") from None
        except BusNotAvailable:
            connection.close()
            raise
        self._rest = b""

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """Return the messages that have come, at most about 64 KiB, and bytes that are no message."""
        pile = self._rest
        for _ in range(_MOST_PILES):
            more = super().read(_PILE)
            pile = self._newest(pile + more)
            if len(more) < _PILE:
                break
        whole, self._rest = _whole_messages(pile)
        return whole

    def _newest(self, pile: bytes) -> bytes:
        """Return the newest whole message and the bytes after it, if there is more than can be used at once."""
        if len(pile) <= CHUNK:
            return pile
        whole, rest = _whole_messages(pile)
        at = whole.rfind(BEGIN)
        if at < 0:
            return pile[-2 * CHUNK :]  # part of no message
        self.dropped += whole.count(BEGIN, 0, at)
        return whole[at:] + rest


def _begin_reading(connection: socket.socket, name: str) -> None:
    """Greet a port and ask it to send."""
    connection.settimeout(_GREETING_S)
    connection.sendall(Carrier.FAST_TCP.greeting(WHO))
    answer = b""
    while len(answer) < _ANSWER and (more := connection.recv(_ANSWER - len(answer))):
        answer += more
    if len(answer) < _ANSWER or unframed(answer) is None:
        raise BusNotAvailable(f"{name}: the program that answers there is no port of YARP", reason=BusReason.FAILED)
    connection.sendall(READ)  # a few bytes into an empty buffer


class YarpBus(ServerBus):
    """A port of a robot. Its name is ``yarp://HOST:PORT/NAME?key=value``, with host and port of the name server.

    ``yarp:///NAME`` asks the name server that YARP's own programs use. The port is looked up before each connection,
    so that a robot whose programs were restarted is found again.

    Args:
        channel: ``HOST:PORT/NAME`` or ``/NAME``.
    """

    scheme: ClassVar[str] = "yarp"
    device_end: ClassVar[Callable[..., Bus] | None] = YarpServerBus

    def _parse(self, channel: str) -> tuple[Address | None, str]:
        return split_channel(channel)

    def _open_port(self) -> Port:
        place, name = self._place
        server = NameServer(*(place or configured_server()))
        try:
            contact = server.query(name)
        except OSError as error:
            raise BusNotAvailable(f"{self.name}: {error}") from None
        if contact is None:
            raise BusNotAvailable(f"{self.name}: {server} knows no port {name}: does the robot's program run?")
        if contact.carrier not in _CARRIERS:
            raise BusNotAvailable(
                f"{self.name}: the port is called by {contact.carrier}, not by tcp", reason=BusReason.FAILED
            )
        return YarpPort(f"yarp://{self.channel}", Address(contact.host, contact.port), self._options.patience_s)


def _whole_messages(pile: bytes) -> tuple[bytes, bytes]:
    """Return the bytes that can be used now, and the message at the end that is not whole yet."""
    at = pile.rfind(BEGIN)
    size = message_size(pile, at) if at >= 0 else 0
    if size is None or (at >= 0 and len(pile) < at + size):
        return pile[:at], pile[at:]
    cut = begun(pile, BEGIN)
    return pile[: len(pile) - cut], pile[len(pile) - cut :]
