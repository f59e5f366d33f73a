"""A driver that runs in a thread on emulated hardware, for tests that read it as a user would."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import msgspec

from skinware import DriverFrame, DriverReader
from skinware.errors import BusNotAvailable, BusSendError
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.can.roboskin import RoboskinDriver, RoboskinOptions
from skinware_drivers.runner import PublishMode, Runner
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.events import CommandReceived
from skinware_drivers.virtual.hardware import EmulatedHardware, WireFrame
from skinware_drivers.virtual.roboskin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin_options import RoboskinOptions as EmulatorOptions


class Driving:
    """A running driver; ``do`` runs something in its event loop, where the emulated hardware may be touched."""

    def __init__(
        self,
        lines: Sequence[tuple[AnyAdapter, Bus]],
        name: str,
        listen_only: bool,
        publish: PublishMode | None = None,
    ) -> None:
        self.ready = threading.Event()
        self.failure: BaseException | None = None
        self._lines = [(f"bus{i}", adapter, bus) for i, (adapter, bus) in enumerate(lines)]
        self._name = name
        self._listen_only = listen_only
        self._publish = publish
        self._loop: asyncio.AbstractEventLoop | None = None
        self.runner: Runner | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)  # one that hangs must not hang pytest

    def _run(self) -> None:
        async def run() -> None:
            self._loop = asyncio.get_running_loop()
            self.runner = Runner(
                self._name,
                self._lines,
                name=self._name,
                listen_only=self._listen_only,
                publish=self._publish,
                slots=64,
                on_ready=self.ready.set,
            )
            await self.runner.run()

        try:
            asyncio.run(run())
        except BaseException as error:  # noqa: BLE001  (shown to the test, which fails on it)
            self.failure = error
            self.ready.set()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        if self.runner is not None and self._loop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self.runner.stop)
        self._thread.join(30)
        assert not self._thread.is_alive(), "the driver did not stop"
        if self.failure is not None:
            raise self.failure

    def do(self, action: Callable[[], object]) -> None:
        """Run in the driver's loop and wait for it."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        assert self._loop is not None
        self._loop.call_soon_threadsafe(act)
        assert done.wait(30)

    def status(self) -> dict[str, Any]:
        assert self.runner is not None
        return self.runner.status()


def emulated(log: list[msgspec.Struct] | None = None, *, listen_only: bool = False, **options: Any) -> VirtualCanBus:
    hardware = EmulatedRoboskin(EmulatorOptions(**options), log=log)
    return VirtualCanBus.with_hardware(hardware, listen_only=listen_only)


def hardware_of(bus: VirtualCanBus) -> EmulatedRoboskin:
    assert isinstance(bus.hardware, EmulatedRoboskin)
    return bus.hardware


def commands(log: list[msgspec.Struct]) -> list[tuple[int, int, str]]:
    """(time_ns, identifier, payload in hex) of what boards were told."""
    return [(e.time_ns, e.identifier, e.payload) for e in log if isinstance(e, CommandReceived)]


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
        opened_at_s: when somebody tried to open it, CLOCK_MONOTONIC s.
    """

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.before_send: Callable[[int, bytes], object] = lambda _identifier, _payload: None
        self.down = False
        self.opened_at_s: list[float] = []

    def open(self) -> None:
        self.opened_at_s.append(time.monotonic())
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


def troubled(log: list[msgspec.Struct] | None = None, **options: Any) -> TroubledBus:
    return TroubledBus.with_hardware(EmulatedRoboskin(EmulatorOptions(**options), log=log))


@contextmanager
def driving(
    *buses: VirtualCanBus,
    listen_only: bool = False,
    wait: bool = True,
    driver: type[RoboskinDriver] = RoboskinDriver,
    publish: PublishMode | None = None,
    **options: Any,
) -> Iterator[Driving]:
    lines = [(driver(RoboskinOptions(**options)), bus) for bus in buses]
    with driving_lines(lines, "roboskin", listen_only=listen_only, wait=wait, publish=publish) as running:
        yield running


@contextmanager
def driving_lines(
    lines: Sequence[tuple[AnyAdapter, Bus]],
    name: str,
    *,
    listen_only: bool = False,
    wait: bool = True,
    publish: PublishMode | None = None,
) -> Iterator[Driving]:
    """Any driver on any buses."""
    running = Driving(lines, name, listen_only, publish)
    running.start()
    try:
        if wait:
            assert running.ready.wait(30)
            if running.failure is not None:
                raise running.failure
        yield running
    finally:
        running.stop()


def read_until(reader: DriverReader, condition: Callable[[DriverFrame], bool], frames: int = 1200) -> DriverFrame:
    """The first frame that fulfils a condition."""
    for count, frame in enumerate(reader.in_order(timeout_s=30)):
        if condition(frame):
            return frame
        assert count < frames, "the frames never came to it"
    raise AssertionError
