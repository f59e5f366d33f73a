"""The bus ``replay``: what went over a wire when it was recorded, again, as the bus of a driver.

The driver decodes it with the times that it had, moved to now. What devices answer comes when this driver has asked: at
a frame that was sent, the recording waits until one with the same identifier is sent again.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated

import msgspec

from skinware.errors import BusNotAvailable, ConfigurationError
from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG, Bus
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import WireFrame
from skinware_drivers.virtual.recorded_modbus import as_on_a_line, modbus_form
from skinware_drivers.virtual.timer import MonotonicTimer

if TYPE_CHECKING:
    from skinware.recording import Recording, WireItem, WireTrack

log: logging.Logger = logging.getLogger("skinware.driver")

_PATIENCE_NS = 500_000_000
"""So long a question is waited for that was asked when it was recorded; the next one of its kind is not, after that."""
_EARLIEST_NS = 250_000_000
"""A question may come so long before its time."""


class ReplayOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a recorded bus."""

    bus: Annotated[str, msgspec.Meta(description="which one, if several were recorded")] = ""
    driver: Annotated[str, msgspec.Meta(description="of which driver, if several had it")] = ""
    speed: Annotated[float, msgspec.Meta(description="2: twice as fast", gt=0)] = 1.0
    start: Annotated[float, msgspec.Meta(description="begin there, s since the recording began", ge=0)] = 0.0
    end: Annotated[Annotated[float, msgspec.Meta(ge=0)] | None, msgspec.Meta(description="end there")] = None


class RecordedWire:
    """The devices at the other end of a recorded wire; see :class:`.hardware.EmulatedHardware`.

    Args:
        items: what went over it, by time.
        first_ns: time of the recording, CLOCK_MONOTONIC of then, at which it begins.
        speed: 2.0: twice as fast.
        waits: for the questions that were asked when it was recorded.
        name: that the end is logged under; empty: it is not.
    """

    def __init__(
        self, items: Iterator[WireItem], first_ns: int, *, speed: float = 1.0, waits: bool = True, name: str = ""
    ) -> None:
        self._items, self._speed, self._waits, self._name = items, speed, waits, name
        self._next: WireItem | None = None
        self._first_ns = first_ns
        self._begun_ns = self._given_ns = 0
        self._has_begun = self._is_over = False
        self._asked: dict[int, deque[tuple[int, bytes]]] = {}
        self._answered: dict[int, bytes] = {}
        self._unasked: set[int] = set()
        self._counts = {"frames": 0, "bursts": 0, "commands": 0}

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        """Take a question."""
        self._counts["commands"] += 1
        self._asked.setdefault(identifier, deque(maxlen=1000)).append((now_ns, payload))
        self._unasked.discard(identifier)

    def next_due_ns(self) -> int | None:
        """When there is something, or a question was waited for long enough; None: at the end."""
        item = self._next
        if item is None or not self._has_begun:
            return None
        due_ns = self._due_ns(item)
        if self._is_waited_for(item):
            return self._asked[_kind(item)][0][0] if self._asked.get(_kind(item)) else due_ns + _PATIENCE_NS
        return due_ns

    def emit(self, now_ns: int) -> list[WireFrame]:
        """What is due."""
        found: list[WireFrame] = []
        while (item := self._next) is not None and self._due_ns(item) <= now_ns:
            if item.is_sent:
                if self._is_waited_for(item) and not self._is_asked(item, now_ns):
                    break
            elif item.identifier is None or not item.identifier & (ERROR_FLAG | REMOTE_FLAG):
                found.append(WireFrame(self._stamp_ns(item), item.identifier or 0, item.data))
            self._take_next()
        self._counts["frames"] += len(found)
        return found

    def skip(self, now_ns: int) -> int:
        """Begin; later, leave out what is due."""
        if self._has_begun:
            return len(self.emit(now_ns))
        self._has_begun, self._begun_ns = True, now_ns
        self._take_next()
        return 0

    def totals(self) -> dict[str, int]:
        """Frames that were given, and questions that were asked."""
        return dict(self._counts)

    def _due_ns(self, item: WireItem) -> int:
        return self._begun_ns + round((item.time_ns - self._first_ns) / self._speed)

    def _stamp_ns(self, item: WireItem) -> int:
        self._given_ns = max(self._given_ns, self._due_ns(item))
        return self._given_ns

    def _is_waited_for(self, item: WireItem) -> bool:
        return self._waits and item.is_sent and _kind(item) not in self._unasked

    def _is_asked(self, item: WireItem, now_ns: int) -> bool:
        """Whether the question was asked, or is waited for no more; if it was asked late, all that follows is late."""
        due_ns, asked = self._due_ns(item), self._asked.get(_kind(item), deque())
        while asked and (asked[0][0] < due_ns - _EARLIEST_NS or self._is_repeated(item, asked[0][1])):
            asked.popleft()
        if asked:
            asked_ns, self._answered[_kind(item)] = asked.popleft()
            self._begun_ns += max(0, asked_ns - due_ns)
            return True
        if now_ns < due_ns + _PATIENCE_NS:
            return False
        self._begun_ns += _PATIENCE_NS
        self._unasked.add(_kind(item))
        return True

    def _is_repeated(self, item: WireItem, question: bytes) -> bool:
        """Whether it was asked again before its answer came, and this is not where it was so when it was recorded."""
        return question == self._answered.get(_kind(item)) and question != item.data

    def _take_next(self) -> None:
        self._next = next(self._items, None)
        if self._next is None and not self._is_over:
            self._is_over = True
            if self._name:
                log.warning("%s: the recording is over", self._name)


def _kind(item: WireItem) -> int:
    """What questions are told apart by."""
    return item.identifier or 0


class ReplayedCanBus(VirtualCanBus):
    """A recorded CAN bus."""

    def __init__(self, wire: RecordedWire, name: str, *, payload_size: int, listen_only: bool) -> None:
        super().__init__("", payload_size=payload_size, listen_only=listen_only, hardware=wire)
        self._name = name

    @property
    def name(self) -> str:
        """As a user writes it."""
        return f"bus {self._name}"


class ReplayedSerialBus(SerialBus):
    """A recorded serial line."""

    def __init__(self, wire: RecordedWire, name: str, *, payload_size: int, listen_only: bool) -> None:
        super().__init__("", payload_size=payload_size, listen_only=listen_only)
        self._wire, self._name = wire, name
        self._recorded: _RecordedPort | None = None

    @property
    def name(self) -> str:
        """As a user writes it."""
        return f"bus {self._name}"

    def _open_port(self) -> Port:
        self._recorded = _RecordedPort(self._wire)
        return self._recorded

    def _read(self, port: Port) -> None:
        """One read, with its own time."""
        chunk = port.read(0)
        if chunk and self._recorded is not None:
            self._hear(chunk, self._recorded.read_ns)


class ReplayedModbusBus(ModbusBus):
    """A recorded Modbus line or connection, which is listened to: the questions are those of then."""

    def __init__(self, wire: RecordedWire, name: str, *, payload_size: int) -> None:
        super().__init__("", payload_size=payload_size, listen_only=True)
        self._wire, self._name = wire, name

    @property
    def name(self) -> str:
        """As a user writes it."""
        return f"bus {self._name}"

    def _open_port(self) -> Port:
        return _RecordedPort(self._wire)


class _RecordedPort(Port):
    """A port that gives what was read, read by read.

    Attributes:
        read_ns: when what was given last was read.
    """

    def __init__(self, wire: RecordedWire) -> None:
        self._wire = wire
        self._timer = MonotonicTimer()
        self._reads: deque[WireFrame] = deque()
        self.read_ns = 0
        wire.skip(time.monotonic_ns())
        self._wake_when_due()

    def fileno(self) -> int:
        return self._timer.fileno()

    def read(self, size: int) -> bytes:  # noqa: ARG002 - as much as was read then
        self._reads += self._wire.emit(time.monotonic_ns())
        if not self._reads:
            self._wake_when_due()
            return b""
        read = self._reads.popleft()
        self._wake_when_due()
        self.read_ns = read.time_ns
        return read.payload

    def write(self, data: bytes) -> int:
        self._wire.receive(0, data, time.monotonic_ns())
        self._wake_when_due()
        return len(data)

    def close(self) -> None:
        self._timer.close()

    def _wake_when_due(self) -> None:
        self._timer.wake_at(0 if self._reads else self._wire.next_due_ns())


def replayed_bus(
    channel: str, options: dict[str, str] | None = None, *, payload_size: int = 8, listen_only: bool = False
) -> Bus:
    """The bus ``replay``: what was recorded of one in the file ``channel``.

    Raises:
        ConfigurationError: an option is unknown or has a bad value, or nothing, or more than one bus, is meant.
        BadRecording: the file is no recording.
        MissingExtra: recordings need packages that are not installed.
        BusNotAvailable: it cannot be read.
    """
    import skinware.recording

    wanted = options_from_strings(ReplayOptions, options or {})
    try:
        recording = skinware.recording.open(channel)
    except OSError as error:
        raise BusNotAvailable(f"{channel}: {error.strerror}") from None
    wire = wire_of(recording, wanted.bus, wanted.driver)
    name = f"replay:{channel} ({wire.bus})"
    items = _items(recording, wire, wanted)
    of_driver = [one for one in recording.wires if one.driver == wire.driver]
    first_ns = first_of(of_driver, wanted.start)
    form = modbus_form(wire.items()) if wire.is_serial else None
    if form is not None:
        heard = RecordedWire(as_on_a_line(items, form), first_ns, speed=wanted.speed, waits=False, name=name)
        return ReplayedModbusBus(heard, name, payload_size=payload_size)
    recorded = RecordedWire(items, first_ns, speed=wanted.speed, waits=not listen_only, name=name)
    kind = ReplayedSerialBus if wire.is_serial else ReplayedCanBus
    return kind(recorded, name, payload_size=payload_size, listen_only=listen_only)


def first_of(wires: Sequence[WireTrack], start_s: float = 0.0) -> int:
    """When something first went over one of these, CLOCK_MONOTONIC ns of then; 0: nothing did.

    Args:
        wires: of one recording.
        start_s: from when on, s since the recording began.
    """
    firsts = (next(wire.items(start_s=start_s), None) for wire in wires)
    return min((first.time_ns for first in firsts if first is not None), default=0)


def _items(recording: Recording, wire: WireTrack, wanted: ReplayOptions) -> Iterator[WireItem]:
    """What is wanted of a wire; the recording is closed after it, or when nobody wants more."""
    with recording:
        yield from wire.items(start_s=wanted.start, end_s=wanted.end)


def wire_of(recording: Recording, bus: str = "", driver: str = "") -> WireTrack:
    """The wire that is meant.

    Args:
        recording: where it is.
        bus: its name; empty: there is only one.
        driver: whose it was; empty: only one had it.

    Raises:
        ConfigurationError: there is none, or more than one.
    """
    wires = recording.wires
    if not wires:
        raise ConfigurationError(f"{recording.path}: no wire was recorded: skin-record --wire records them")
    found = [wire for wire in wires if bus in ("", wire.bus) and driver in ("", wire.driver)]
    if len(found) == 1:
        return found[0]
    there_are = ", ".join(f"bus={wire.bus}&driver={wire.driver}" for wire in wires)
    of_driver = f" of {driver}" if driver else ""
    what = "which bus?" if found else f"no bus {bus}{of_driver};"
    raise ConfigurationError(f"{recording.path}: {what} there are: {there_are}")


__all__ = ["RecordedWire", "ReplayOptions", "first_of", "replayed_bus", "wire_of"]
