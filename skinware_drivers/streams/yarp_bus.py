"""A port of a robot that runs YARP as a bus that is only read: found by its name, read in the carrier ``fast_tcp``.

The port never waits for us. What has come is read whenever the loop comes round, as much as there is; if more has piled
up than is read at once otherwise, because this machine was held up, only the newest message of it is used, and the
others are counted as lost.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Any, ClassVar

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.realtime import now_ns
from skinware.status import BusReason
from skinware.yarp.carriers import READ, Carrier, unframed
from skinware.yarp.names import DEFAULT_PORT, WHO, NameServer, configured_server, is_port_name
from skinware_drivers.bus import Bus
from skinware_drivers.serial.ports import Port
from skinware_drivers.serial.stream import CHUNK
from skinware_drivers.streams.bus import Address, ServerBus, parse_address
from skinware_drivers.streams.tcp import TcpPort, connect
from skinware_drivers.streams.yarp_messages import BEGIN, message_size

_ROOM = 1 << 20
"""Wanted of the kernel, for what comes while this machine is held up."""
_PILE = 1 << 20
_MOST_PILES = 8
_GREETING_S = 3.0
_ANSWER = 8
_CARRIERS = ("tcp", "fast_tcp", "text", "text_ack")
"""As what ports register that can be called by TCP."""


def split_channel(channel: str) -> tuple[Address | None, str]:
    """Name server, None if it is not given, and port of ``HOST:PORT/NAME``.

    Raises:
        ConfigurationError: it is none.
    """
    place, slash, name = channel.partition("/")
    if not is_port_name(slash + name):
        raise ConfigurationError(
            f"bus yarp://{channel}: which port? Write yarp://HOST:PORT/NAME with the name server's host and port, as"
            " yarp://192.168.1.10:10000/icub/skin/left_hand_comp, or yarp:///NAME"
        )
    return parse_address("yarp", place, default_port=DEFAULT_PORT) if place else None, slash + name


def _device_end(channel: str, options: dict[str, str] | None = None, **more: Any) -> Bus:
    """A name server with one port; see :class:`skinware_drivers.streams.yarp_serving.YarpServerBus`."""
    from skinware_drivers.streams.yarp_serving import YarpServerBus

    return YarpServerBus(channel, options, **more)


class YarpPort(TcpPort):
    """A connection to a port, which sends its messages to us from then on. Gives whole messages.

    It is called in the carrier ``fast_tcp``, never in ``text``: a real port that sends vectors writes past a buffer
    when it is read in text, and its program dies (YARP 2.3.64 to 4.0.0, ``BufferedConnectionWriter``).

    Attributes:
        passed_over: messages that were not used as newer ones had come already.
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
        self.passed_over = 0

    def read(self, size: int) -> bytes:  # noqa: ARG002
        """The messages that have come, at most about 64 KiB; what is no message is given too.

        Raises:
            BusNotAvailable: the port is gone.
        """
        pile = self._rest
        for _ in range(_MOST_PILES):
            more = super().read(_PILE)
            pile = self._newest(pile + more)
            if len(more) < _PILE:
                break
        whole, self._rest = _whole_messages(pile)
        return whole

    def _newest(self, pile: bytes) -> bytes:
        """Of more than can be used at once, the newest whole message and what follows."""
        if len(pile) <= CHUNK:
            return pile
        whole, rest = _whole_messages(pile)
        at = whole.rfind(BEGIN)
        if at < 0:
            return pile[-2 * CHUNK :]  # of no message, it does not matter what it is
        self.passed_over += whole.count(BEGIN, 0, at)
        return whole[at:] + rest


def _begin_reading(connection: socket.socket, name: str) -> None:
    """Greet a port, and ask it to send.

    Raises:
        BusNotAvailable: what answers is no port of YARP.
        OSError: it hung up, or did not answer in time.
    """
    connection.settimeout(_GREETING_S)
    connection.sendall(Carrier.FAST_TCP.greeting(WHO))
    answer = b""
    while len(answer) < _ANSWER and (more := connection.recv(_ANSWER - len(answer))):
        answer += more
    if len(answer) < _ANSWER or unframed(answer) is None:
        raise BusNotAvailable(f"{name}: what answers at this port is no port of YARP", reason=BusReason.FAILED)
    connection.sendall(READ)  # a few bytes into an empty buffer


class YarpBus(ServerBus):
    """A port of a robot. Its name is ``yarp://HOST:PORT/NAME?key=value``, with host and port of the name server.

    ``yarp:///NAME`` asks the name server that YARP's own programs use. The port is looked up whenever it is connected
    to, so that a robot whose programs were restarted is found again.

    Args:
        channel: ``HOST:PORT/NAME`` or ``/NAME``.
        options: see :class:`skinware_drivers.streams.bus.ServerOptions`.
        payload_size: longest body that fits into a batch.
        listen_only: makes no difference: only the request to be sent messages goes out.

    Raises:
        ConfigurationError: no such name, or an option is unknown or has a bad value.
    """

    device_end: ClassVar[Callable[..., Bus] | None] = _device_end

    def __init__(
        self, channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
    ) -> None:
        super().__init__(channel, options, payload_size=payload_size, listen_only=listen_only)
        self._server, self._name = split_channel(channel)

    @property
    def name(self) -> str:
        return f"bus yarp://{self.channel}"

    def _open_port(self) -> Port:
        server = NameServer(*(self._server or configured_server()))
        try:
            contact = server.query(self._name)
        except OSError as error:
            raise BusNotAvailable(f"{self.name}: {error}") from None
        if contact is None:
            raise BusNotAvailable(f"{self.name}: {server} knows no port {self._name}: does the robot's program run?")
        if contact.carrier not in _CARRIERS:
            raise BusNotAvailable(
                f"{self.name}: the port is called by {contact.carrier}, not by tcp", reason=BusReason.FAILED
            )
        return YarpPort(f"yarp://{self.channel}", Address(contact.host, contact.port), self._options.patience_s)

    def _read(self, port: Port) -> None:
        if messages := port.read(CHUNK):
            time_ns = now_ns()
            for start in range(0, len(messages), CHUNK):
                self._hear(messages[start : start + CHUNK], time_ns)
        if isinstance(port, YarpPort):
            self.counters.lost += port.passed_over
            port.passed_over = 0


def _whole_messages(pile: bytes) -> tuple[bytes, bytes]:
    """What can be used now, and the message at the end that is not whole yet."""
    at = pile.rfind(BEGIN)
    size = message_size(pile, at) if at >= 0 else 0
    if size is None or (at >= 0 and len(pile) < at + size):
        return pile[:at], pile[at:]
    cut = next((n for n in range(len(BEGIN) - 1, 0, -1) if pile.endswith(BEGIN[:n])), 0)
    return pile[: len(pile) - cut], pile[len(pile) - cut :]
