"""The bus ``replay``: what went over a wire when it was recorded, again, as the bus of a driver.

The driver decodes it with the times that it had, moved to now. What devices answer comes when this driver has asked: at
a frame that was sent, the recording waits until one with the same identifier is sent again. On Modbus the questions are
those that were recorded, and the driver need not ask.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import msgspec

from skinware.errors import ConfigurationError
from skinware_drivers.bus import Bus, chosen_by
from skinware_drivers.bus_names import parse_bus_name
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import Port
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hand_clock import MonotonicTimer, Timer
from skinware_drivers.virtual.recorded_modbus import ReplayedModbusBus, was_over_tcp
from skinware_drivers.virtual.recorded_wire import Note, RecordedPort, RecordedWire

if TYPE_CHECKING:
    from skinware.recording import Recording, WireItem, WireTrack


class ReplayOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a recorded bus."""

    bus: Annotated[str, msgspec.Meta(description="which one, if several were recorded")] = ""
    driver: Annotated[str, msgspec.Meta(description="of which driver, if several had it")] = ""
    speed: Annotated[float, msgspec.Meta(description="2: twice as fast", gt=0)] = 1.0
    start: Annotated[float, msgspec.Meta(description="begin there, s since the recording began", ge=0)] = 0.0
    end: Annotated[Annotated[float, msgspec.Meta(ge=0)] | None, msgspec.Meta(description="end there")] = None


class Recorded(NamedTuple):
    """What a driver said of itself when its wire was recorded.

    Attributes:
        driver_type: as ``--driver`` takes it; empty: the file does not say.
        listen_only: it sent nothing.
        options: of the driver for this bus.
    """

    driver_type: str = ""
    listen_only: bool = False
    options: Mapping[str, Any] = MappingProxyType({})


class Clock(NamedTuple):
    """Time in which something is replayed.

    Attributes:
        now_ns: tells CLOCK_MONOTONIC ns.
        timer: makes what wakes readers.
    """

    now_ns: Callable[[], int] = time.monotonic_ns
    timer: Callable[[], Timer] = MonotonicTimer


class ReplayedCanBus(VirtualCanBus):
    """A recorded CAN bus."""

    def __init__(self, wire: RecordedWire, name: str, clock: Clock, *, payload_size: int, listen_only: bool) -> None:
        super().__init__(
            "",
            payload_size=payload_size,
            listen_only=listen_only,
            hardware=wire,
            clock=clock.now_ns,
            make_timer=clock.timer,
        )
        self._name = name

    @property
    def name(self) -> str:
        return f"bus {self._name}"


class ReplayedSerialBus(SerialBus):
    """A recorded serial line."""

    opens_slowly = False

    def __init__(self, wire: RecordedWire, name: str, clock: Clock, *, payload_size: int, listen_only: bool) -> None:
        super().__init__("", payload_size=payload_size, listen_only=listen_only)
        self._wire, self._name, self._clock = wire, name, clock
        self._recorded: RecordedPort | None = None

    @property
    def name(self) -> str:
        return f"bus {self._name}"

    def _open_port(self) -> Port:
        self._recorded = RecordedPort(self._wire, self._clock.now_ns, self._clock.timer)
        return self._recorded

    def _read(self, port: Port) -> None:
        chunk = port.read(0)
        if chunk and self._recorded is not None:
            self._hear(chunk, self._recorded.read_ns)


_CLASSES: dict[str, type[Bus]] = {"serial": ReplayedSerialBus, "modbus": ReplayedModbusBus}


def _class_of(channel: str, options: dict[str, str]) -> type[Bus]:
    wanted = options_from_strings(ReplayOptions, options)
    with _open(channel) as recording:
        medium = medium_of(recording, wire_of(recording, wanted.bus, wanted.driver))
        return _CLASSES.get(medium, ReplayedCanBus)


@chosen_by(_class_of)
def replayed_bus(
    channel: str,
    options: dict[str, str] | None = None,
    *,
    payload_size: int = 8,
    listen_only: bool = False,
    clock: Clock | None = None,
    note: Note | None = None,
) -> Bus:
    """The bus ``replay``: what was recorded of one in the file ``channel``.

    Args:
        channel: the file.
        options: see :class:`ReplayOptions`.
        payload_size: longest payload that the layout knows.
        listen_only: refuse to send, and wait for no question.
        clock: in whose time; default: in real time.
        note: is told of all that is given; see :class:`.recorded_wire.RecordedWire`.

    Raises:
        ConfigurationError: an option is unknown or has a bad value, the file cannot be read, or nothing, or more than
            one bus, is meant.
        BadRecording: the file is no recording.
        MissingExtra: recordings need packages that are not installed.
    """
    wanted = options_from_strings(ReplayOptions, options or {})
    recording = _open(channel)
    wire = wire_of(recording, wanted.bus, wanted.driver)
    name, clock = f"replay:{channel} ({wire.bus})", clock or Clock()
    items = _items(recording, wire, wanted)
    of_driver = [one for one in recording.wires if one.driver == wire.driver]
    first_ns = first_of(of_driver, wanted.start)
    more: dict[str, Any] = {"payload_size": payload_size, "listen_only": listen_only}
    play = partial(RecordedWire, items, first_ns, speed=wanted.speed, name=name, note=note)
    if medium_of(recording, wire) == "modbus":
        recorded = play(waits=False, with_sent=True)
        begin = partial(RecordedPort, recorded, clock.now_ns, clock.timer)
        return ReplayedModbusBus(begin, name, over_tcp=was_over_tcp(wire.items()), **more)
    recorded = play(waits=not listen_only)
    kind = ReplayedSerialBus if medium_of(recording, wire) == "serial" else ReplayedCanBus
    return kind(recorded, name, clock, **more)


def recorded_driver(bus_name: str) -> Recorded:
    """What the driver said of itself whose wire a bus' name means.

    Args:
        bus_name: ``replay:FILE?key=value``.

    Raises:
        ConfigurationError, BadRecording, MissingExtra: as for :func:`replayed_bus`.
    """
    _, channel, options = parse_bus_name(bus_name)
    wanted = options_from_strings(ReplayOptions, options)
    with _open(channel) as recording:
        wire = wire_of(recording, wanted.bus, wanted.driver)
        about = recording.about(wire.driver)
        own = about.get("buses", {}).get(wire.bus, {}).get("options", {})
        return Recorded(str(about.get("driver_type", "")), bool(about.get("listen_only")), dict(own))


def _open(path: str) -> Recording:
    import skinware.recording

    try:
        return skinware.recording.open(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}") from None


def medium_of(recording: Recording, wire: WireTrack) -> str:
    """``can``, ``serial`` or ``modbus``: as the driver said, or by what was recorded."""
    known = recording.about(wire.driver).get("buses", {}).get(wire.bus, {}).get("medium")
    return str(known or ("serial" if wire.is_serial else "can"))


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
