"""Let other programs ask through our line: by Modbus TCP, or by a serial port (RTU) that they open.

:class:`Guests` chooses which of their questions goes out next, and refuses those that cannot be asked. As the master,
it reads no clock and knows no socket.
"""

from __future__ import annotations

import contextlib
import ipaddress
import select
import socket
from abc import ABC, abstractmethod
from collections import defaultdict, deque

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.realtime import NS_PER_S
from skinware_drivers.counters import FramerCounters
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.wire import Message
from skinware_drivers.running.guard import Backoff, pauses_of_device
from skinware_drivers.serial.ports import Port, PtyPort
from skinware_drivers.streams.bus import Address, parse_address, reason_of
from skinware_drivers.streams.tcp import TcpPort

_MOST_GUESTS, _MOST_WAITING = 16, 8
"""Programs at a time, and questions of one that may wait before no more of it are read."""
_CHUNK = 300
"""Bytes read at once: a few questions, so that a flood stays in the kernel, which then holds up its sender."""
_PATIENCE_S = 5
_SILENCE_NS = NS_PER_S // 20
"""On a serial port, half a question is dropped after this time."""
_HERE = "127.0.0.1"
_NO_SUCH_FUNCTION, _BAD_VALUE, _NO_WAY, _NO_ANSWER = 1, 3, 10, 11
_EVERY_UNIT = 0


class Guest(ABC):
    """A program that asks; its questions wait in the order in which it asked, with the numbers that it gave them."""

    def __init__(self) -> None:
        self.waiting: deque[Message] = deque()

    @abstractmethod
    def reply(self, message: Message) -> None:
        """Send the program the reply to one of its questions."""


class Guests:
    """The programs that ask besides the master: one question goes out at a time, in each program's own order.

    Programs take turns. A write comes before a read, but not twice in a row. A unit that has left three questions of
    programs in a row unanswered is asked more and more rarely, because each silence costs the line two timeouts.

    Args:
        may_write: False: refuse every write.
        over_tcp: the line is a connection. On a serial line, unit 0 means every unit, and none answers.
    """

    def __init__(self, *, may_write: bool, over_tcp: bool) -> None:
        self._may_write, self._over_tcp = may_write, over_tcp
        self._guests: list[Guest] = []  # the one that was served longest ago comes first
        self._open: tuple[Guest, Message] | None = None
        self._has_written = False
        self._had_turn = False  # the newest question on the line was one of theirs
        self._silent: defaultdict[int, Backoff] = defaultdict(pauses_of_device)

    @property
    def are_waiting(self) -> bool:
        return any(guest.waiting for guest in self._guests)

    def join(self, guest: Guest) -> None:
        self._guests.append(guest)

    def leave(self, guest: Guest) -> None:
        """Forget the guest's questions, and drop the reply to its open one when it comes."""
        guest.waiting.clear()
        self._guests.remove(guest)

    def ask(self, guest: Guest, question: Message) -> None:
        """Queue a question. One that cannot be asked is refused after the guest's earlier ones are answered."""
        guest.waiting.append(question)
        if self._open is None or self._open[0] is not guest:
            self._refuse_first(guest)

    def next(self, time_ns: int, *, is_read_due: bool) -> Message | None:
        """Take the question that is to be asked now, if any; call ``answer`` when it is over.

        Between two reads that are due, one question is asked.
        """
        if is_read_due and self._had_turn:
            self._had_turn = False
            return None
        while waiting := [guest for guest in self._guests if guest.waiting]:
            waiting.sort(key=lambda guest: wire.is_write(guest.waiting[0].data) is self._has_written)
            guest = waiting[0]
            self._guests.remove(guest)
            self._guests.append(guest)
            question = guest.waiting.popleft()
            retry = self._silent.get(question.unit)
            if retry is not None and time_ns < retry.not_before_ns:
                self._refuse(guest, question, _NO_ANSWER)
                self._refuse_first(guest)
                continue
            self._has_written = wire.is_write(question.data)
            self._open = guest, question
            self._had_turn = True
            return question
        self._had_turn = False
        return None

    def give_up(self) -> None:
        """Refuse the open question: its reply will not come."""
        if self._open is not None:
            (guest, question), self._open = self._open, None
            self._refuse(guest, question, _NO_ANSWER)
            self._refuse_first(guest)

    def answer(self, reply: bytes | None, time_ns: int) -> None:
        """End the open question, if there is one, with a reply (or exception) of the unit, or None."""
        if self._open is None:
            return
        guest, question = self._open
        if reply is None:
            self._silent[question.unit].begin(time_ns)
            self.give_up()
            return
        self._open = None
        self._silent.pop(question.unit, None)
        if guest in self._guests:
            guest.reply(question._replace(data=reply))
        self._refuse_first(guest)

    def _refuse_first(self, guest: Guest) -> None:
        """Refuse the questions at the head of a guest's queue that cannot be asked."""
        while guest.waiting:
            question = guest.waiting[0]
            if not wire.is_known(question.data) or (wire.is_write(question.data) and not self._may_write):
                code = _NO_SUCH_FUNCTION
            elif not wire.is_question(question.data):
                code = _BAD_VALUE
            elif question.unit == _EVERY_UNIT and not self._over_tcp:
                code = _NO_WAY
            else:
                return
            self._refuse(guest, guest.waiting.popleft(), code)

    def _refuse(self, guest: Guest, question: Message, code: int) -> None:
        if guest in self._guests:
            guest.reply(question._replace(data=bytes([question.data[0] | wire.FAILED, code])))


class _Program(Guest):
    """A program at a port: its own connection, or the serial port that it may open.

    The gateway waits for the events ``watched`` at that port.
    """

    def __init__(self, port: Port, messages: wire.TcpMessages | wire.RtuMessages) -> None:
        super().__init__()
        self.port = port
        self.watched = 0
        self._messages = messages
        self._unsent = b""
        self._heard_ns = 0

    @property
    def interest(self) -> int:
        is_full = len(self.waiting) >= _MOST_WAITING or self._unsent
        return (0 if is_full else select.EPOLLIN) | (select.EPOLLOUT if self._unsent else 0)

    def questions(self, time_ns: int) -> list[Message]:
        chunk, messages = self.port.read(_CHUNK), self._messages
        if isinstance(messages, wire.TcpMessages):
            return list(messages.feed(chunk))
        if time_ns - self._heard_ns > _SILENCE_NS:
            messages.drop()
        self._heard_ns = time_ns
        messages.feed(chunk)
        return list(iter(lambda: messages.next_of(None), None))

    def reply(self, message: Message) -> None:
        if isinstance(self._messages, wire.TcpMessages):
            self._unsent += wire.tcp_frame(message)
        elif not self._unsent:  # else no program reads, and the next one to open the port must not find old replies
            self._unsent = wire.rtu_frame(message)
        self.send()

    def send(self) -> None:
        """Write as much of the replies as the port takes."""
        if self._unsent:
            with contextlib.suppress(OSError):  # the program has gone, as the next read will show
                self._unsent = self._unsent[self.port.write(self._unsent) :]


class Gateway:
    """Let other programs ask through our line.

    Args:
        places: ``PORT`` or ``HOST:PORT`` for Modbus TCP, or a path for a serial port, separated by commas.
        is_public: other machines may reach it.
    """

    def __init__(self, places: str, guests: Guests, *, is_public: bool) -> None:
        self.guests = guests
        self._links = [place for place in places.split(",") if "/" in place]
        self._addresses = [_address(place, is_public=is_public) for place in places.split(",") if "/" not in place]
        self._epoll: select.epoll | None = None
        self._listeners: dict[int, socket.socket] = {}
        self._programs: dict[int, _Program] = {}
        self.note = ""

    def open(self) -> None:
        self._epoll = select.epoll()
        try:
            for address in self._addresses:
                family, numbers = address.resolve(socket.SOCK_STREAM)
                try:
                    listener = socket.create_server(numbers, family=family, backlog=_MOST_GUESTS)
                except OSError as error:
                    raise BusNotAvailable(f"gateway: cannot listen on {address}: {reason_of(error)}") from None
                listener.setblocking(False)
                self._listeners[listener.fileno()] = listener
                self._epoll.register(listener, select.EPOLLIN)
            for link in self._links:
                self._welcome(_Program(PtyPort(link), wire.RtuMessages(FramerCounters())))
        except BusNotAvailable:
            self.close()
            raise
        listening = [str(Address(*each.getsockname()[:2])) for each in self._listeners.values()]
        self.note = f"gateway at {', '.join(listening + self._links)}"

    def fileno(self) -> int:
        return -1 if self._epoll is None else self._epoll.fileno()

    def serve(self, time_ns: int) -> None:
        """Accept programs, take their questions, and send what could not be sent before; then call ``watch``."""
        if self._epoll is None:
            return
        for fd, events in self._epoll.poll(0):
            if fd in self._listeners:
                with contextlib.suppress(OSError):
                    connection, _ = self._listeners[fd].accept()
                    if len(self._programs) < _MOST_GUESTS:
                        port = TcpPort("gateway", connection, _PATIENCE_S)
                        self._welcome(_Program(port, wire.TcpMessages(FramerCounters())))
                    else:
                        connection.close()
            elif fd in self._programs:
                self._attend(self._programs[fd], events, time_ns)

    def watch(self) -> None:
        """Wait for what each program may do next: to be called after ``serve`` and after replies."""
        for fd, program in self._programs.items():
            if self._epoll is not None and program.interest != program.watched:
                program.watched = program.interest
                self._epoll.modify(fd, program.watched)

    def close(self) -> None:
        epoll, self._epoll = self._epoll, None
        for program in list(self._programs.values()):
            self._dismiss(program)
        for listener in self._listeners.values():
            listener.close()
        self._listeners.clear()
        if epoll is not None:
            epoll.close()

    def _welcome(self, program: _Program) -> None:
        self._programs[program.port.fileno()] = program
        self.guests.join(program)
        if self._epoll is not None:
            self._epoll.register(program.port.fileno(), program.watched)
        self.watch()

    def _attend(self, program: _Program, events: int, time_ns: int) -> None:
        if events & (select.EPOLLHUP | select.EPOLLERR):
            self._dismiss(program)
            return
        program.send()
        if not program.interest & select.EPOLLIN:
            return
        try:
            for question in program.questions(time_ns):
                self.guests.ask(program, question)
        except (BusNotAvailable, ValueError):
            self._dismiss(program)

    def _dismiss(self, program: _Program) -> None:
        del self._programs[program.port.fileno()]
        self.guests.leave(program)
        program.port.close()


def _address(place: str, *, is_public: bool) -> Address:
    if ":" not in place and not place.isdecimal():
        raise ConfigurationError(f"gateway={place}: which port? Give PORT, HOST:PORT, or a path such as /tmp/hand")
    address = parse_address("gateway:tcp", f"{_HERE}:{place}" if place.isdecimal() else place)
    with contextlib.suppress(ValueError):
        if ipaddress.ip_address(address.host).is_loopback:
            return address
    if address.host != "localhost" and not is_public:
        raise ConfigurationError(
            f"gateway {place}: programs that reach it can move the device; to admit other machines, add"
            " gateway_public=yes"
        )
    return address
