"""A driver that runs in a thread on emulated hardware, for tests that read it as a user would."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import msgspec

from skinware import DriverFrame, DriverReader
from skinware_drivers.can.roboskin import RoboskinDriver, RoboskinOptions
from skinware_drivers.runner import Runner
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.roboskin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin_options import RoboskinOptions as EmulatorOptions


class Driving:
    """A running driver; ``do`` runs something in its event loop, where the emulated hardware may be touched."""

    def __init__(self, buses: Sequence[VirtualCanBus], options: dict[str, Any], listen_only: bool) -> None:
        self.buses = buses
        self.ready = threading.Event()
        self.failure: BaseException | None = None
        lines = [(f"bus{i}", RoboskinDriver(RoboskinOptions(**options)), bus) for i, bus in enumerate(buses)]
        self._lines = lines
        self._listen_only = listen_only
        self._loop: asyncio.AbstractEventLoop | None = None
        self.runner: Runner | None = None
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        async def run() -> None:
            self._loop = asyncio.get_running_loop()
            self.runner = Runner(
                "roboskin",
                self._lines,
                name="roboskin",
                listen_only=self._listen_only,
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


@contextmanager
def driving(*buses: VirtualCanBus, listen_only: bool = False, wait: bool = True, **options: Any) -> Iterator[Driving]:
    running = Driving(buses, options, listen_only)
    running.start()
    try:
        if wait:
            assert running.ready.wait(30)
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
