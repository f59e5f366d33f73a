"""A recorded Modbus line or connection: the questions that were asked then, and their replies."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from skinware.errors import BusNotAvailable
from skinware.realtime import now_ns
from skinware_drivers.bus import FrameBatch
from skinware_drivers.counters import BusCounters, FramerCounters
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.modbus.master import ANSWERS, Overheard
from skinware_drivers.modbus.registers import Row, Wanted
from skinware_drivers.modbus.wire import Message
from skinware_drivers.virtual.recorded_wire import SENT, RecordedPort

if TYPE_CHECKING:
    from skinware.recording import WireItem


class Conversation:
    """Pairs recorded questions with their replies, and answers a driver's own questions by them.

    Args:
        wanted: what is looked for in the replies.
        counters: of the bus.
        over_tcp: a connection; else a serial line.

    Attributes:
        rows: frames that have become whole; whoever takes them removes them.
    """

    def __init__(self, wanted: Wanted, counters: BusCounters, *, over_tcp: bool) -> None:
        self.rows: deque[Row] = deque()
        self._counters = counters
        self._overheard = Overheard(wanted)
        self._line = None if over_tcp else wire.RtuMessages(counters.framing)
        self._asking, self._answering = wire.TcpMessages(counters.framing), wire.TcpMessages(counters.framing)
        self._asked: dict[int, Message] = {}
        self._replies: dict[tuple[int, bytes], bytes] = {}
        self._waiting: list[Message] = []

    def heard(self, chunk: bytes, time_ns: int, *, is_sent: bool) -> None:
        if self._line is not None:
            self._follow(self._line, chunk, time_ns)
            return
        try:
            for message in (self._asking if is_sent else self._answering).feed(chunk):
                if is_sent:
                    self._asked[message.number] = message
                elif (asked := self._asked.pop(message.number, None)) is not None:
                    self._pair(asked, message, time_ns)
                else:
                    self._counters.refused += 1
        except ValueError:  # it is counted, and the connection was given up
            self._asked.clear()

    def command(self, message: Message, time_ns: int) -> None:
        """Answer a question by what was answered then: at once, or when that comes."""
        reply = self._replies.get((message.unit, message.data))
        if reply is None:
            self._waiting.append(message)
        else:
            self.rows.append(Row(time_ns, ANSWERS | message.unit, reply))

    def _follow(self, line: wire.RtuMessages, chunk: bytes, time_ns: int) -> None:
        line.feed(chunk)
        while (message := line.next_of(self._asked.get(0))) is not None:
            asked = self._asked.pop(0, None)
            if asked is None or message.unit != asked.unit or not wire.is_reply(asked.data, message.data):
                self._asked[0] = message
            else:
                self._pair(asked, message, time_ns)

    def _pair(self, asked: Message, reply: Message, time_ns: int) -> None:
        key = asked.unit, asked.data
        self._replies[key] = reply.data
        if any((one.unit, one.data) == key for one in self._waiting):
            self._waiting = [one for one in self._waiting if (one.unit, one.data) != key]
            self.rows.append(Row(time_ns, ANSWERS | asked.unit, reply.data))
        if wire.exception_of(reply.data):
            self._counters.errors += 1
        elif asked.data[0] in wire.READS and wire.is_reply(asked.data, reply.data):
            self.rows += self._overheard.take(asked, reply.data[2:], time_ns)


class ReplayedModbusBus(ModbusBus):
    """A recorded Modbus line or connection. It asks nothing: what was asked then is there.

    Args:
        open_port: begins with what was recorded, in both directions.
        name: as a user writes it.
        over_tcp: it was a connection.
        payload_size: longest frame.
        listen_only: refuse every ``send``.
    """

    opens_slowly = False
    is_recorded = True

    def __init__(
        self,
        open_port: Callable[[], RecordedPort],
        name: str,
        *,
        over_tcp: bool,
        payload_size: int,
        listen_only: bool,
    ) -> None:
        super().__init__("recorded", payload_size=payload_size, listen_only=listen_only)
        self._begin_port, self._name, self._over_tcp = open_port, name, over_tcp
        self._recorded: RecordedPort | None = None
        self._conversation = Conversation(self._wanted, self.counters, over_tcp=over_tcp)

    @property
    def name(self) -> str:
        return f"bus {self._name}"

    @property
    def asks(self) -> bool:
        return False

    @property
    def reads_natively(self) -> bool:
        return False

    def use(self, wanted: Wanted, *timing: Any) -> None:
        """Say what is looked for; when it was asked for, is recorded."""
        super().use(wanted, *timing)
        self._conversation = Conversation(self._wanted, self.counters, over_tcp=self._over_tcp)

    def open(self) -> None:
        if self._recorded is None:
            self._recorded = self._begin_port()

    def fileno(self) -> int:
        """A descriptor that is readable when ``receive`` has something to do; -1 while the bus is closed."""
        return -1 if self._recorded is None else self._recorded.fileno()

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        port, talk = self._recorded, self._conversation
        if port is None:
            raise BusNotAvailable(f"{self!r} is not open")
        while len(talk.rows) < batch.free and (item := port.next_frame()) is not None:
            is_sent = item.identifier == SENT
            self.tap.keep_bytes(item.time_ns, item.payload, is_sent=is_sent)
            talk.heard(item.payload, item.time_ns, is_sent=is_sent)
        taken = 0
        while talk.rows and batch.free:
            row = talk.rows.popleft()
            if len(row.payload) <= batch.payload_size:
                batch.append(ordinal, *row)
                taken += 1
        self.counters.frames += taken
        if talk.rows:
            port.wake()
        return taken

    def send(self, identifier: int, payload: bytes) -> None:
        """A question of the driver's own; see :class:`skinware_drivers.modbus.bus.ModbusBus`."""
        port = self.may_send_by(self._recorded)
        self._conversation.command(Message(identifier, payload), now_ns())
        port.wake()

    def close(self) -> None:
        port, self._recorded = self._recorded, None
        if port is not None:
            port.close()


def was_over_tcp(items: Iterable[WireItem]) -> bool:
    """Whether a recorded conversation was in a connection: a question says so, whatever the bus was called."""
    asked = next((item.data for item in items if item.is_sent), b"")
    try:
        messages = list(wire.TcpMessages(FramerCounters()).feed(asked))
    except ValueError:
        return False
    return bool(messages) and wire.is_question(messages[0].data)
