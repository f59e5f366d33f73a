"""Run a driver, and emulated devices, in threads and in real time, for tests that read the driver as a user would."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

from skinware.driver_service import DriverReader
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.options import NoOptions, options_of
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.running.building import PublishMode
from skinware_drivers.running.generation import FlowLoop
from skinware_drivers.running.runner import Runner
from skinware_drivers.serial.bus import PtyBus
from skinware_drivers.streams.tcp import TcpServerBus
from skinware_drivers.testing.waiting import SLOWER, defect, require
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.emulation import Emulation
from skinware_drivers.virtual.hardware import EmulatedHardware, load_emulator

_LONGEST_S = 15.0 * SLOWER
"""Time for a driver to begin, and to end: a wrong driver should fail soon."""
_EMULATION_S = 30.0
_LONGEST_WRITE = 4096


class Driving:
    """A driver in a thread.

    Args:
        options: as for :class:`skinware_drivers.running.runner.Runner`.

    Attributes:
        ready: set when it publishes.
        failure: the exception that ended it, if it failed.
        runner: the runner, once the thread has made it.
    """

    def __init__(
        self, lines: Sequence[tuple[AnyAdapter, Bus]], name: str, bus_names: Sequence[str] = (), **options: Any
    ) -> None:
        self.ready: threading.Event = threading.Event()
        self.failure: BaseException | None = None
        self.runner: Runner | None = None
        names = bus_names or [f"bus{i}" for i in range(len(lines))]
        self._lines = [(name, adapter, bus) for name, (adapter, bus) in zip(names, lines, strict=True)]
        self._name, self._options = name, options
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)  # one that hangs must not hang pytest

    def _run(self) -> None:
        async def run() -> None:
            self._loop = asyncio.get_running_loop()
            self.runner = Runner(
                self._name, self._lines, name=self._name, slots=64, on_ready=self.ready.set, **self._options
            )
            await self.runner.run()

        try:
            with asyncio.Runner(loop_factory=FlowLoop) as loop:
                loop.run(run())
        except BaseException as error:  # noqa: BLE001  (raised in the test)
            self.failure = error
            self.ready.set()

    def start(self) -> None:
        self._thread.start()

    def wait(self) -> None:
        """Wait until it publishes; raise the exception that ended it."""
        require(self.ready.wait(_LONGEST_S), f"the driver published nothing within {_LONGEST_S:g} s")
        if self.failure is not None:
            raise self.failure

    def stop(self) -> None:
        """Stop it as ``skin-driver`` does; raise the exception that ended it."""
        if self.runner is not None and self._loop is not None and self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # it has failed and closed its loop, and its thread is about to end
                self._loop.call_soon_threadsafe(self.runner.stop)
        self._thread.join(_LONGEST_S)
        require(not self._thread.is_alive(), "the driver did not stop")
        if self.failure is not None:
            raise self.failure

    def do(self, action: Callable[[], object]) -> None:
        """Run something in the driver's event loop, where emulated hardware may be changed, and wait for it."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        require(self._loop is not None, "the driver does not run")
        if self._loop is not None:
            self._loop.call_soon_threadsafe(act)
        require(done.wait(_LONGEST_S), "the driver's loop is stuck")

    def status(self) -> dict[str, Any]:
        """Return the figures of every bus and patch, as in ``skin-driver --json``."""
        return {} if self.runner is None else self.runner.status()


@contextmanager
def driving_lines(
    lines: Sequence[tuple[AnyAdapter, Bus]],
    name: str,
    *,
    listen_only: bool = False,
    wait: bool = True,
    publish: PublishMode | None = None,
    wait_for_buses: bool = False,
    bus_names: Sequence[str] = (),
) -> Iterator[Driving]:
    """Run a driver on any buses while the block runs.

    Args:
        lines: an adapter and an unopened bus for every bus.
        wait: begin the block when the driver publishes.
        publish: see :class:`skinware_drivers.running.runner.Runner`.
        wait_for_buses: see :class:`skinware_drivers.running.runner.Runner`.
        bus_names: names of the buses; default: bus0, bus1 ...

    Raises:
        ConfigurationError: an adapter's declarations are not complete, as for the command ``skin-driver``.
    """
    for adapter, _ in lines:
        adapter.check()
    running = Driving(lines, name, bus_names, listen_only=listen_only, publish=publish, wait_for_buses=wait_for_buses)
    running.start()
    try:
        if wait:
            running.wait()
        yield running
    finally:
        running.stop()


class _Control:
    """Wait for the start of an emulation in another thread, and end it."""

    def __init__(self) -> None:
        self.stopped = False
        self.ready = threading.Event()
        self.failure: BaseException | None = None
        self.event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        return self.event

    def note(self, event: str, **_facts: Any) -> None:
        if event == "ready":
            self.ready.set()


@contextmanager
def emulated_on_a_pty(emulator: Any, **options: Any) -> Iterator[str]:
    """Run emulated devices while the block runs, and yield the path of their serial port.

    Args:
        emulator: class or registered name of an emulator of serial devices.
    """
    bus = PtyBus("", payload_size=_LONGEST_WRITE)
    with emulated_on(bus, emulator, **options):
        yield bus.note.removeprefix("serial port ")


@contextmanager
def emulated_over_tcp(emulator: Any, **options: Any) -> Iterator[str]:
    """Run emulated devices while the block runs, and yield ``HOST:PORT``, to which a driver can connect.

    Args:
        emulator: class or registered name of an emulator of serial or Modbus devices.
    """
    bus = TcpServerBus("127.0.0.1:0", payload_size=_LONGEST_WRITE)
    with emulated_on(bus, emulator, **options):
        yield bus.note.removeprefix("listens on ")


@contextmanager
def emulated_on(bus: Bus, emulator: Any, **options: Any) -> Iterator[None]:
    """Run emulated devices on a bus while the block runs.

    Args:
        bus: not opened yet.
        emulator: class or registered name of an emulator.
    """
    if isinstance(emulator, str):
        emulator = load_emulator(emulator)
    with carried_on(bus, emulator(options_of(emulator, options))):
        yield


@contextmanager
def carried_on(bus: Bus, hardware: EmulatedHardware) -> Iterator[None]:
    """Carry the frames of emulated devices over a bus while the block runs.

    Args:
        bus: not opened yet.
    """
    control = _Control()

    def run() -> None:
        try:
            emulation = Emulation(bus, hardware, control.note)
            emulation.run(control, bus_name=bus.name, driver=type(hardware).__name__, options=NoOptions())
        except BaseException as error:  # noqa: BLE001  (raised in the test)
            control.failure = error
            control.ready.set()

    thread = threading.Thread(target=run, name="emulated devices", daemon=True)
    thread.start()
    try:
        require(control.ready.wait(_EMULATION_S), "the emulated devices did not start")
        if control.failure is not None:
            raise control.failure
        yield
    finally:
        control.stopped = True
        os.eventfd_write(control.event, 1)
        thread.join(_EMULATION_S)
        os.close(control.event)
    require(not thread.is_alive(), "the emulated devices did not stop")
    if control.failure is not None:
        raise control.failure


class EmulatedSkin(NamedTuple):
    """A driver that runs on emulated devices in this process.

    Attributes:
        bus: the bus. Call its ``vanish`` and ``come_back`` only within ``driver.do``.
        hardware: the devices, to be changed only within ``driver.do``; None: they are on a serial line, or on a bus of
            yours.
    """

    driver: Driving
    reader: DriverReader
    bus: Bus
    hardware: EmulatedHardware | None


@contextmanager
def emulated_skin(
    driver: str | type[AnyAdapter],
    emulator: Any = None,
    *,
    name: str = "skin",
    driver_options: Mapping[str, Any] | None = None,
    bus: str = "",
    **emulator_options: Any,
) -> Iterator[EmulatedSkin]:
    """Run a driver on emulated devices, or on a bus of your own, while the block runs.

    Args:
        emulator: class of the devices; by default the one registered under the driver's name, unless there is a
            ``bus``. Serial devices get a pseudo terminal.
        bus: name of a bus (``vcan0``, a pseudo terminal). With ``emulator``, the devices are emulated on it; without,
            it has devices already.
    """
    driver_class = load_driver(driver) if isinstance(driver, str) else driver
    adapter = driver_class(options_of(driver_class, driver_options or {}))
    factory: Any = emulator or (load_emulator(driver) if isinstance(driver, str) else None)
    hardware: EmulatedHardware | None = None
    with ExitStack() as running:
        if not bus:
            if factory is None:
                defect(f"say which emulator {driver} is to run on")
            if adapter.medium in ("serial", "modbus"):
                bus = running.enter_context(emulated_on_a_pty(factory, **emulator_options))
                bus = f"{adapter.medium}:{bus}"
        elif emulator is not None:
            own = make_bus(bus, payload_size=adapter.payload_size)
            running.enter_context(emulated_on(own, emulator, **emulator_options))
        if bus or factory is None:
            line = make_bus(bus, payload_size=adapter.payload_size)
        else:
            hardware = factory(options_of(factory, emulator_options))
            line = VirtualCanBus("", hardware=hardware, payload_size=adapter.payload_size)
        driving = running.enter_context(driving_lines([(adapter, line)], name))
        reader = running.enter_context(DriverReader(name, timeout_s=_LONGEST_S))
        yield EmulatedSkin(driving, reader, line, hardware)
