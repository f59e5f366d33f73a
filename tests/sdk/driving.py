"""A driver that runs in a thread on emulated hardware, for tests that read it as a user would."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self
from unittest import mock

from skinware import status
from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import BusNotAvailable, BusSendError, StructureChanged
from skinware.status import BusReason, Status
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.running.building import PublishMode
from skinware_drivers.testing.driving import Driving, driving_lines
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import EmulatedHardware, Event, WireFrame
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions as EmulatorOptions

SILENCE_NS = 600_000_000
"""How long boards may be silent in tests: a busy machine lets the threads of a test wait for longer than 0.2 s."""


def emulated(log: list[Event] | None = None, *, listen_only: bool = False, **options: Any) -> VirtualCanBus:
    hardware = EmulatedRoboskin(EmulatorOptions(**options), log=log)
    return VirtualCanBus("", hardware=hardware, listen_only=listen_only)


def hardware_of(bus: VirtualCanBus) -> EmulatedRoboskin:
    assert isinstance(bus.hardware, EmulatedRoboskin)
    return bus.hardware


def commands(log: list[Event]) -> list[tuple[int, int, str]]:
    """(time_ns, identifier, payload in hex) of what boards were told."""
    return [(e.time_ns, e.identifier, e.payload or "") for e in log if e.event == "command_received"]


def restarted_on_demand(emulator: Any) -> Any:
    """The same devices, of which the first loses its power for a moment once ``restart_now`` is set.

    How long a driver takes to come up, nobody knows beforehand: ``restart_after_s`` might be over by then.
    """

    class Restarted(emulator):  # type: ignore[misc]
        restart_now = False

        def emit(self, now_ns: int) -> list[WireFrame]:
            if Restarted.restart_now:
                Restarted.restart_now = False
                self.restart(self.numbers[0], now_ns)
            return list(super().emit(now_ns))

    return Restarted


class EveryFrame:
    """Reads in the driver's own thread, in order, after each take: no machine is too busy for that.

    Attributes:
        taken: the frames.
        reader: what reads them.
    """

    def __init__(self, running: Driving, name: str = "roboskin") -> None:
        assert running.runner is not None
        assert running.runner.builder.writer is not None
        self.taken: list[DriverSnapshot] = []
        self.reader: DriverReader = DriverReader(name)
        assert running.runner.builder.generation is not None
        generation = running.runner.builder.generation
        places: list[tuple[object, str]] = [(generation, "digest"), (generation.path, "publish_if_due")]
        frames = self.reader.in_order(timeout_s=30)

        def and_read(publish: Callable[..., None]) -> Callable[..., None]:
            def call(*arguments: Any) -> None:
                publish(*arguments)
                while self.reader.newest_position != (self.taken[-1].position if self.taken else None):
                    self.taken.append(next(frames))

            return call

        def read() -> None:
            for place, name in places:
                setattr(place, name, and_read(getattr(place, name)))

        def forget() -> None:
            for place, name in places:
                delattr(place, name)

        running.do(read)
        self._forget: Callable[[], None] = lambda: running.do(forget)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._forget()
        self.reader.close()


class LateBoards:
    """Devices that are not there until ``present`` is set."""

    def __init__(self, hardware: EmulatedHardware, present: bool = False) -> None:
        self._hardware = hardware
        self.present = present

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        if self.present:
            self._hardware.receive(identifier, payload, now_ns)

    def next_due_ns(self) -> int | None:
        return self._hardware.next_due_ns()

    def emit(self, now_ns: int) -> list[WireFrame]:
        return [frame for frame in self._hardware.emit(now_ns) if self.present]

    def skip(self, now_ns: int) -> int:
        return self._hardware.skip(now_ns)

    def totals(self) -> dict[str, int]:
        return self._hardware.totals()


class Together:
    """Several sets of devices on one bus."""

    def __init__(self, *parts: EmulatedHardware) -> None:
        self._parts = parts

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        for hardware in self._parts:
            hardware.receive(identifier, payload, now_ns)

    def next_due_ns(self) -> int | None:
        due = [time_ns for hardware in self._parts if (time_ns := hardware.next_due_ns()) is not None]
        return min(due, default=None)

    def emit(self, now_ns: int) -> list[WireFrame]:
        return sorted(frame for hardware in self._parts for frame in hardware.emit(now_ns))

    def skip(self, now_ns: int) -> int:
        return sum(hardware.skip(now_ns) for hardware in self._parts)

    def totals(self) -> dict[str, int]:
        return self._parts[0].totals()


class Chatter:
    """Foreign devices that send the same frames every 10 ms, and hear everything that is sent on the bus."""

    def __init__(self, *frames: tuple[int, bytes]) -> None:
        self._frames = frames
        self._due_ns = 0
        self.heard: list[tuple[int, bytes]] = []

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        self.heard.append((identifier, payload))

    def next_due_ns(self) -> int | None:
        return self._due_ns if self._frames else None

    def emit(self, now_ns: int) -> list[WireFrame]:
        if now_ns < self._due_ns:
            return []
        self._due_ns = now_ns + 10_000_000
        return [WireFrame(now_ns, identifier, payload) for identifier, payload in self._frames]

    def skip(self, now_ns: int) -> int:
        return len(self.emit(now_ns))

    def totals(self) -> dict[str, int]:
        return {}


class TroubledBus(VirtualCanBus):
    """A bus whose troubles the test decides.

    Attributes:
        before_send: called before every send; may raise, or change the bus.
        down: the interface is down: it cannot be opened, and nothing can be sent.
        refused: this user may not open it.
        opened_at_s: when somebody tried to open it, CLOCK_MONOTONIC s.
    """

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.before_send: Callable[[int, bytes], object] = lambda _identifier, _payload: None
        self.down = False
        self.refused = False
        self.opened_at_s: list[float] = []

    def open(self) -> None:
        self.opened_at_s.append(time.monotonic())
        if self.refused:
            raise BusNotAvailable("not permitted", reason=BusReason.REFUSED)
        if self.down:
            raise BusNotAvailable("the bus is down", is_down=True)
        super().open()

    def send(self, identifier: int, payload: bytes) -> None:
        self.before_send(identifier, payload)
        if self.down:
            raise BusSendError("the bus is down")
        super().send(identifier, payload)

    def go_down(self) -> None:
        self.down = True
        self.fail_next_receive(BusNotAvailable("the bus went down", is_down=True))


def troubled(log: list[Event] | None = None, **options: Any) -> TroubledBus:
    return TroubledBus("", hardware=EmulatedRoboskin(EmulatorOptions(**options), log=log))


def is_whole(frame: DriverSnapshot) -> bool:
    return not (frame.status & (Status.STALE | Status.NEVER_SEEN)).any()


def has_come(frame: DriverSnapshot) -> bool:
    """Every sensor has had a value: it may be stale, as that of a replay that is over."""
    return not (frame.status & Status.NEVER_SEEN).any()


def later_than(last: DriverSnapshot) -> Callable[[DriverSnapshot], bool]:
    return lambda frame: frame.sequence > last.sequence


def follow(reader: DriverReader, condition: Callable[[Any], bool]) -> Any:
    """The first frame that fulfils a condition, over as many generations as it takes."""
    while True:
        try:
            return read_until(reader, condition)
        except StructureChanged:
            reader.reattach()


@contextmanager
def driving(
    *buses: VirtualCanBus,
    listen_only: bool = False,
    wait: bool = True,
    driver: type[RoboskinDriver] = RoboskinDriver,
    publish: PublishMode | None = None,
    wait_for_buses: bool = False,
    **options: Any,
) -> Iterator[Driving]:
    lines = [(driver(RoboskinOptions(**options)), bus) for bus in buses]
    with (
        mock.patch.object(status, "_LEAST_NS", SILENCE_NS),
        driving_lines(
            lines, "roboskin", listen_only=listen_only, wait=wait, publish=publish, wait_for_buses=wait_for_buses
        ) as running,
    ):
        yield running


__all__ = ["Driving", "driving_lines", "read_until"]
