"""Where other programs ask through our line: a Modbus TCP server, or a serial port (RTU) that they open."""

from __future__ import annotations

import contextlib
import ipaddress
import select
import socket
from abc import abstractmethod

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.realtime import NS_PER_S
from skinware_drivers.counters import FramerCounters
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.guests import Guest, Guests
from skinware_drivers.modbus.wire import Message
from skinware_drivers.serial.ports import PtyPort
from skinware_drivers.streams.bus import Address, parse_address, reason_of
from skinware_drivers.streams.tcp import keep_alive

_MOST_GUESTS, _MOST_WAITING = 16, 8
"""Programs at a time; questions of one that wait, before no more of it are read."""
_CHUNK = 300
"""Bytes read at once: a few questions, so that a flood stays in the kernel, which then holds up its sender."""
_PATIENCE_S = 5
_SILENCE_NS = NS_PER_S // 20
"""On a serial port, half a question is none after so long."""
_HERE = "127.0.0.1"


class _Program(Guest):
    """A guest at a descriptor.

    Attributes:
        watched: for what its descriptor is waited.
    """

    def __init__(self) -> None:
        super().__init__()
        self.watched = 0
        self._unsent = b""

    @property
    def interest(self) -> int:
        is_full = len(self.waiting) >= _MOST_WAITING or self._unsent
        return (0 if is_full else select.EPOLLIN) | (select.EPOLLOUT if self._unsent else 0)

    @abstractmethod
    def fileno(self) -> int:
        """Its descriptor."""

    @abstractmethod
    def heard(self, time_ns: int) -> list[Message]:
        """Its new questions.

        Raises:
            ConnectionError: it has gone, or what it sends is no Modbus.
        """

    @abstractmethod
    def close(self) -> None:
        """Have no more to do with it."""

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """What can be written now; gives how many bytes that were."""

    @abstractmethod
    def _frame(self, reply: Message) -> bytes: ...

    def tell(self, reply: Message) -> None:
        self._unsent += self._frame(reply)
        self.go_on()

    def go_on(self) -> None:
        if self._unsent:
            with contextlib.suppress(OSError):  # it has gone, as reading will show
                self._unsent = self._unsent[self._write(self._unsent) :]


class _Caller(_Program):
    """A program that has connected."""

    def __init__(self, connection: socket.socket) -> None:
        super().__init__()
        connection.setblocking(False)
        keep_alive(connection, _PATIENCE_S)
        self._connection = connection
        self._messages = wire.TcpMessages(FramerCounters())

    def fileno(self) -> int:
        return self._connection.fileno()

    def heard(self, time_ns: int) -> list[Message]:  # noqa: ARG002
        try:
            chunk = self._connection.recv(_CHUNK)
        except BlockingIOError:
            return []
        except OSError as error:
            raise ConnectionError(error.strerror) from None
        if not chunk:
            raise ConnectionError("closed")
        try:
            return list(self._messages.feed(chunk))
        except ValueError as error:
            raise ConnectionError(str(error)) from None

    def close(self) -> None:
        self._connection.close()

    def _write(self, data: bytes) -> int:
        try:
            return self._connection.send(data)
        except BlockingIOError:
            return 0

    def _frame(self, reply: Message) -> bytes:
        return wire.tcp_frame(reply)


class _OpensPort(_Program):
    """Whoever opens the serial port."""

    def __init__(self, link: str) -> None:
        super().__init__()
        self._port = PtyPort(link)
        self._messages = wire.RtuMessages(FramerCounters())
        self._heard_ns = 0

    def fileno(self) -> int:
        return self._port.fileno()

    def heard(self, time_ns: int) -> list[Message]:
        try:
            chunk = self._port.read(_CHUNK)
        except BusNotAvailable as error:
            raise ConnectionError(str(error)) from None
        if time_ns - self._heard_ns > _SILENCE_NS:
            self._messages.drop()
        self._heard_ns = time_ns
        self._messages.feed(chunk)
        found = []
        while (message := self._messages.next_of(None)) is not None:
            found.append(message)
        return found

    def close(self) -> None:
        self._port.close()

    def tell(self, reply: Message) -> None:
        """Write a reply, unless nobody reads those before: who opens the port next is not to find them."""
        if not self._unsent:
            super().tell(reply)

    def _write(self, data: bytes) -> int:
        return self._port.write(data)

    def _frame(self, reply: Message) -> bytes:
        return wire.rtu_frame(reply)


class Gateway:
    """Lets other programs ask through our line.

    Args:
        places: ``PORT`` or ``HOST:PORT`` for Modbus TCP, or a path for a serial port, with commas between them.
        guests: whose questions are asked.
        is_public: other machines may reach it.

    Attributes:
        note: where it is.

    Raises:
        ConfigurationError: it is no such place, or one that other machines reach though that is not wanted.
    """

    def __init__(self, places: str, guests: Guests, *, is_public: bool) -> None:
        self.guests = guests
        self._addresses: list[Address] = []
        self._links: list[str] = []
        for place in places.split(","):
            if "/" in place:
                self._links.append(place)
            else:
                self._addresses.append(_address(place, is_public=is_public))
        self._epoll: select.epoll | None = None
        self._listeners: dict[int, socket.socket] = {}
        self._programs: dict[int, _Program] = {}
        self.note = ""

    def open(self) -> None:
        """Begin to listen.

        Raises:
            BusNotAvailable: it cannot be reached there, as when another program listens at that port.
        """
        self._epoll = select.epoll()
        try:
            for address in self._addresses:
                self._listen(address)
            for link in self._links:
                self._welcome(_OpensPort(link))
        except BusNotAvailable:
            self.close()
            raise
        listening = [str(Address(*each.getsockname()[:2])) for each in self._listeners.values()]
        self.note = f"gateway at {', '.join(listening + self._links)}"

    def fileno(self) -> int:
        return -1 if self._epoll is None else self._epoll.fileno()

    def serve(self, time_ns: int) -> None:
        """Answer callers, take questions, and write what could not be written at once; ``watch`` comes after it."""
        if self._epoll is None:
            return
        for fd, events in self._epoll.poll(0):
            if fd in self._listeners:
                self._accept(self._listeners[fd])
            elif fd in self._programs:
                self._attend(self._programs[fd], events, time_ns)

    def watch(self) -> None:
        """Wait for what each program may do now: after ``serve``, and after replies."""
        for fd, program in self._programs.items():
            if self._epoll is not None and program.interest != program.watched:
                program.watched = program.interest
                self._epoll.modify(fd, program.watched)

    def close(self) -> None:
        """Hang up, and listen no more. Idempotent."""
        epoll, self._epoll = self._epoll, None
        for program in list(self._programs.values()):
            self._dismiss(program)
        for listener in self._listeners.values():
            listener.close()
        self._listeners.clear()
        if epoll is not None:
            epoll.close()

    def _listen(self, address: Address) -> None:
        family, numbers = address.resolve(socket.SOCK_STREAM)
        try:
            listener = socket.create_server(numbers, family=family, backlog=_MOST_GUESTS)
        except OSError as error:
            raise BusNotAvailable(f"gateway: cannot listen on {address}: {reason_of(error)}") from None
        listener.setblocking(False)
        self._listeners[listener.fileno()] = listener
        if self._epoll is not None:
            self._epoll.register(listener, select.EPOLLIN)

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            connection, _ = listener.accept()
            if len(self._programs) < _MOST_GUESTS:
                self._welcome(_Caller(connection))
            else:
                connection.close()

    def _welcome(self, program: _Program) -> None:
        self._programs[program.fileno()] = program
        self.guests.come(program)
        if self._epoll is not None:
            self._epoll.register(program.fileno(), program.watched)
        self.watch()

    def _attend(self, program: _Program, events: int, time_ns: int) -> None:
        if events & (select.EPOLLHUP | select.EPOLLERR):
            self._dismiss(program)
            return
        program.go_on()
        if not program.interest & select.EPOLLIN:
            return
        try:
            for question in program.heard(time_ns):
                self.guests.ask(program, question)
        except ConnectionError:
            self._dismiss(program)

    def _dismiss(self, program: _Program) -> None:
        del self._programs[program.fileno()]
        self.guests.leave(program)
        program.close()


def _address(place: str, *, is_public: bool) -> Address:
    if ":" not in place and not place.isdecimal():
        raise ConfigurationError(f"gateway={place}: which port? Give PORT, HOST:PORT, or a path such as /tmp/hand")
    address = parse_address("gateway:tcp", f"{_HERE}:{place}" if place.isdecimal() else place)
    with contextlib.suppress(ValueError):
        if ipaddress.ip_address(address.host).is_loopback:
            return address
    if address.host != "localhost" and not is_public:
        raise ConfigurationError(
            f"gateway {place}: whoever reaches it moves the device; to let other machines, say gateway_public=yes"
        )
    return address
