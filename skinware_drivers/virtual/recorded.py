"""The buses ``replay`` and ``file``: the recorded or logged traffic of a wire as the bus of a driver.

The driver decodes it with the recorded times, moved to now. An answer of a device comes when this driver has asked: at
a frame that was sent, the recording waits until one with the same identifier is sent again. On Modbus the questions
come from the recording, and the driver need not ask.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware.limits import SLOWEST_REPLAY
from skinware.realtime import now_ns
from skinware.wire import WireItem
from skinware_drivers.bus import Bus, FrameBatch, chosen_by
from skinware_drivers.bus_names import parse_bus_name
from skinware_drivers.counters import BusCounters, FramerCounters
from skinware_drivers.fields import Reply
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.modbus.master import ANSWERS, Listener
from skinware_drivers.modbus.registers import Wanted
from skinware_drivers.modbus.wire import Message, TcpMessages, is_question
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.virtual.bus import EmulatedLine, EmulatedPort, VirtualCanBus
from skinware_drivers.virtual.hand_clock import REAL_CLOCK, Clock
from skinware_drivers.virtual.hardware import WireFrame
from skinware_drivers.virtual.logs import LogFile, WireSource
from skinware_drivers.virtual.recorded_wire import SENT, Note, RecordedWire

if TYPE_CHECKING:
    from skinware.recording import Recording


_MCAP = b"\x89MCAP"


class ReplayOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    bus: Annotated[str, msgspec.Meta(description="name of the bus, if several were recorded")] = ""
    driver: Annotated[str, msgspec.Meta(description="driver of the bus, if several had it")] = ""
    speed: Annotated[
        Annotated[float, msgspec.Meta(ge=SLOWEST_REPLAY)] | Literal["max"],
        msgspec.Meta(description="2: twice as fast; max: as fast as the driver decodes, without losses"),
    ] = 1.0
    start: Annotated[float, msgspec.Meta(description="where to begin, s since the recording began", ge=0, le=1e9)] = 0.0
    end: Annotated[
        Annotated[float, msgspec.Meta(ge=0, le=1e9)] | None,
        msgspec.Meta(description="where to end, as start"),
    ] = None


class Recorded(NamedTuple):
    """The driver that ran when its wire was recorded.

    Attributes:
        driver_type: as ``--driver`` takes it; empty: not in the file.
    """

    driver_type: str = ""
    listen_only: bool = False
    options: Mapping[str, Any] = MappingProxyType({})


class ReplayedCanBus(VirtualCanBus):
    name = Bus.name


class RecordedPort(EmulatedPort):
    """A port that returns the bytes of the recording, read by read.

    Attributes:
        read_ns: when the newest returned bytes were read.
    """

    read_ns = 0

    def read(self, size: int) -> bytes:  # noqa: ARG002
        frame = self.next_frame()
        return b"" if frame is None else frame.payload

    def next_frame(self) -> WireFrame | None:
        if not self._unread:
            self._unread += self._hardware.emit(self._clock())
        frame = self._unread.popleft() if self._unread else None
        self._wake_when_due()
        if frame is not None:
            self.read_ns = frame.time_ns
        return frame

    def wake(self) -> None:
        self._timer.wake_at(0)


class ReplayedSerialBus(EmulatedLine, SerialBus):
    name = Bus.name

    def _open_port(self) -> RecordedPort:
        return RecordedPort(self.hardware, self._clock)

    def _read(self, port: Port) -> None:
        chunk = port.read(0)
        if chunk and isinstance(port, RecordedPort):
            self._hear(chunk, port.read_ns)


class Conversation(Listener):
    """Pair recorded questions with their replies, and answer a driver's own questions by them.

    Args:
        wanted: the registers to look for in the replies.
        over_tcp: the recording is of a connection, not of a serial line.
    """

    def __init__(self, wanted: Wanted, counters: BusCounters, *, over_tcp: bool) -> None:
        super().__init__(wanted, counters)
        self._over_tcp = over_tcp
        self._asking, self._answering = TcpMessages(counters.framing), TcpMessages(counters.framing)
        self._numbered: dict[int, Message] = {}
        self._replies: dict[tuple[int, bytes], bytes] = {}
        self._waiting: list[Message] = []

    def take(self, chunk: bytes, time_ns: int, *, is_sent: bool) -> None:
        if not self._over_tcp:
            self.heard(chunk, time_ns)
            return
        try:
            for message in (self._asking if is_sent else self._answering).feed(chunk):
                if is_sent:
                    self._numbered[message.number] = message
                elif (asked := self._numbered.pop(message.number, None)) is not None:
                    self._pair(asked, message, time_ns)
                else:
                    self._counters.refused += 1
        except ValueError:  # it is counted, and the connection was given up
            self._numbered.clear()

    def command(self, message: Message, time_ns: int) -> None:
        """Answer a question by its recorded reply: at once, or when that comes."""
        reply = self._replies.get((message.unit, message.data))
        if reply is None:
            self._waiting.append(message)
        else:
            self.rows.append(Reply(time_ns, ANSWERS | message.unit, reply))

    def _pair(self, asked: Message, reply: Message, time_ns: int) -> None:
        key = asked.unit, asked.data
        self._replies[key] = reply.data
        if any((one.unit, one.data) == key for one in self._waiting):
            self._waiting = [one for one in self._waiting if (one.unit, one.data) != key]
            self.rows.append(Reply(time_ns, ANSWERS | asked.unit, reply.data))
        super()._pair(asked, reply, time_ns)


class ReplayedModbusBus(ModbusBus):
    """A recorded Modbus line or connection. It asks nothing, because the recording has the questions.

    Args:
        hardware: the recording, in both directions.
        over_tcp: it was a connection.
    """

    opens_slowly = False
    is_recorded = True
    name, asks = Bus.name, Bus.asks

    def __init__(
        self,
        channel: str,
        *,
        hardware: RecordedWire,
        clock: Clock,
        over_tcp: bool,
        payload_size: int,
        listen_only: bool,
    ) -> None:
        super().__init__(channel, payload_size=payload_size, listen_only=listen_only, clock=clock)
        self._hardware, self._over_tcp = hardware, over_tcp
        self._recorded: RecordedPort | None = None
        self._conversation = Conversation(self._wanted, self.counters, over_tcp=over_tcp)

    @property
    def reads_natively(self) -> bool:
        return False

    def use(self, wanted: Wanted, *timing: Any) -> None:
        """Set the registers to look for; the recording has the timing."""
        super().use(wanted, *timing)
        self._conversation = Conversation(self._wanted, self.counters, over_tcp=self._over_tcp)

    def open(self) -> None:
        if self._recorded is None:
            self._recorded = RecordedPort(self._hardware, self._clock)

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
            talk.take(item.payload, item.time_ns, is_sent=is_sent)
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
        """Send a question of the driver's own; see :class:`skinware_drivers.modbus.bus.ModbusBus`."""
        port = self.may_send_by(self._recorded)
        self._conversation.command(Message(identifier, payload), now_ns())
        port.wake()

    def close(self) -> None:
        port, self._recorded = self._recorded, None
        if port is not None:
            port.close()


def _class_of(channel: str, options: dict[str, str]) -> type[Bus]:
    wanted = options_from_strings(ReplayOptions, options)
    with _open(channel, wanted.bus) as recording:
        medium = medium_of(recording, wire_of(recording, wanted.bus, wanted.driver))
    classes: dict[str, type[Bus]] = {"serial": ReplayedSerialBus, "modbus": ReplayedModbusBus}
    return classes.get(medium, ReplayedCanBus)


@chosen_by(_class_of)
def replayed_bus(
    channel: str,
    options: dict[str, str] | None = None,
    *,
    payload_size: int = 8,
    listen_only: bool = False,
    clock: Clock = REAL_CLOCK,
    note: Note | None = None,
) -> Bus:
    """Make the bus ``replay`` or ``file`` of a bus in the file ``channel``, a recording or a log of another program.

    Args:
        listen_only: refuse to send, and wait for no question.
        note: is called for each frame; see :class:`.recorded_wire.RecordedWire`.
    """
    wanted = options_from_strings(ReplayOptions, options or {})
    recording = _open(channel, wanted.bus)
    wire = wire_of(recording, wanted.bus, wanted.driver)
    name = f"replay:{channel} ({wire.bus})"
    items = _items(recording, wire, wanted)
    first_ns = first_of([one for one in recording.wires if one.driver == wire.driver], wanted.start)
    more: dict[str, Any] = {"payload_size": payload_size, "listen_only": listen_only, "clock": clock}
    speed = math.inf if wanted.speed == "max" else wanted.speed
    play = partial(RecordedWire, items, first_ns, speed=speed, name=name, note=note)
    medium = medium_of(recording, wire)
    if medium == "modbus":
        hardware = play(waits=False, with_sent=True)
        return ReplayedModbusBus(name, hardware=hardware, over_tcp=_was_over_tcp(wire.items()), **more)
    kind = ReplayedSerialBus if medium == "serial" else ReplayedCanBus
    return kind(name, hardware=play(waits=not listen_only), **more)


def recorded_driver(bus_name: str) -> Recorded:
    """Return the driver of the recorded bus that a bus' name means.

    Args:
        bus_name: ``replay:FILE?key=value`` or ``file:FILE?key=value``.
    """
    _, channel, options = parse_bus_name(bus_name)
    wanted = options_from_strings(ReplayOptions, options)
    with _open(channel, wanted.bus) as recording:
        wire = wire_of(recording, wanted.bus, wanted.driver)
        about = recording.about(wire.driver)
        own = about.get("buses", {}).get(wire.bus, {}).get("options", {})
        return Recorded(str(about.get("driver_type", "")), bool(about.get("listen_only")), dict(own))


def _open(path: str, bus: str) -> Recording | LogFile:
    try:
        with open(path, "rb") as file:
            if not file.read(len(_MCAP)).startswith(_MCAP):
                return LogFile(path, bus)
        import skinware.recording

        return skinware.recording.open(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from None


def medium_of(recording: Recording | LogFile, wire: WireSource) -> str:
    """Return ``can``, ``serial`` or ``modbus``: of the recorded driver, else by the recorded items."""
    known = recording.about(wire.driver).get("buses", {}).get(wire.bus, {}).get("medium")
    return str(known or ("serial" if wire.is_serial else "can"))


def first_of(wires: Sequence[WireSource], start_s: float = 0.0) -> int:
    """Return the time of the first item on any of these wires, in the recording's CLOCK_MONOTONIC ns; 0: none.

    Args:
        start_s: earliest time, s since the recording began.
    """
    firsts = (next(wire.items(start_s=start_s), None) for wire in wires)
    return min((first.time_ns for first in firsts if first is not None), default=0)


def _items(recording: Recording | LogFile, wire: WireSource, wanted: ReplayOptions) -> Iterator[WireItem]:
    with recording:
        yield from wire.items(start_s=wanted.start, end_s=wanted.end)


def wire_of(recording: Recording | LogFile, bus: str = "", driver: str = "") -> WireSource:
    """Return a recorded wire.

    Args:
        bus: its name; empty: any.
        driver: its driver; empty: any.
    """
    wires = recording.wires
    if not wires:
        raise ConfigurationError(f"{recording.path}: no wire was recorded: skin-record --wire records them")
    found = [wire for wire in wires if bus in ("", wire.bus) and driver in ("", wire.driver)]
    if len(found) == 1:
        return found[0]
    there_are = ", ".join(f"bus={wire.bus}&driver={wire.driver}".removesuffix("&driver=") for wire in wires)
    what = "which bus?" if found else f"no bus {bus}{f' of {driver}' if driver else ''};"
    raise ConfigurationError(f"{recording.path}: {what} there are: {there_are}")


def _was_over_tcp(items: Iterable[WireItem]) -> bool:
    """Return whether a recorded conversation was over a connection: a question shows it, whatever the bus' name."""
    asked = next((item.data for item in items if item.is_sent), b"")
    try:
        messages = list(TcpMessages(FramerCounters()).feed(asked))
    except ValueError:
        return False
    return bool(messages) and is_question(messages[0].data)
