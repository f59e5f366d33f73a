"""A driver that runs in a thread, in real time, for tests that read it as a user would."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import msgspec

from skinware.driver_service import DriverReader
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.running.building import PublishMode
from skinware_drivers.running.flow import FlowLoop
from skinware_drivers.running.runner import Runner
from skinware_drivers.testing.carrying import emulated_on, emulated_on_a_pty
from skinware_drivers.testing.defect import defect, require
from skinware_drivers.testing.waiting import SLOWER
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import EmulatedHardware, load_emulator

_LONGEST_S = 15.0 * SLOWER
"""For a driver to begin, and to end: a wrong one is to be told soon."""


class Driving:
    """A running driver; ``do`` runs something in its event loop, where the emulated hardware may be touched.

    Attributes:
        ready: set once it publishes.
        failure: what it ended with, if it failed.
        runner: the runner, once there is one.
    """

    def __init__(
        self,
        lines: Sequence[tuple[AnyAdapter, Bus]],
        name: str,
        listen_only: bool,
        publish: PublishMode | None = None,
        wait_for_buses: bool = False,
        bus_names: Sequence[str] = (),
    ) -> None:
        self.ready: threading.Event = threading.Event()
        self.failure: BaseException | None = None
        self.runner: Runner | None = None
        names = bus_names or [f"bus{i}" for i in range(len(lines))]
        self._lines = [(name, adapter, bus) for name, (adapter, bus) in zip(names, lines, strict=True)]
        self._name = name
        self._listen_only = listen_only
        self._publish = publish
        self._wait_for_buses = wait_for_buses
        self._loop: asyncio.AbstractEventLoop | None = None
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
                wait_for_buses=self._wait_for_buses,
                slots=64,
                on_ready=self.ready.set,
            )
            await self.runner.run()

        try:
            with asyncio.Runner(loop_factory=FlowLoop) as loop:
                loop.run(run())
        except BaseException as error:  # noqa: BLE001  (shown to the test, which fails on it)
            self.failure = error
            self.ready.set()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def wait(self) -> None:
        """Wait until it publishes; what it failed with is raised here."""
        require(self.ready.wait(_LONGEST_S), f"the driver published nothing within {_LONGEST_S:g} s")
        if self.failure is not None:
            raise self.failure

    def stop(self) -> None:
        """End it in good order; what it failed with is raised here."""
        if self.runner is not None and self._loop is not None and self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # it has failed and closed its loop, and its thread is about to end
                self._loop.call_soon_threadsafe(self.runner.stop)
        self._thread.join(_LONGEST_S)
        require(not self._thread.is_alive(), "the driver did not stop")
        if self.failure is not None:
            raise self.failure

    def do(self, action: Callable[[], object]) -> None:
        """Run in the driver's loop and wait for it."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        require(self._loop is not None, "the driver does not run")
        if self._loop is not None:
            self._loop.call_soon_threadsafe(act)
        require(done.wait(_LONGEST_S), "the driver's loop is stuck")

    def status(self) -> dict[str, Any]:
        """Figures of every bus and patch, as ``skin-driver --json`` tells them."""
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
    """A driver on any buses, as long as the ``with`` lasts.

    Args:
        lines: an adapter and an unopened bus for every bus.
        name: of the driver in the namespace.
        listen_only: send nothing.
        wait: until it publishes.
        publish: see :class:`skinware_drivers.running.runner.Runner`.
        wait_for_buses: likewise.
        bus_names: of each bus; default: bus0, bus1 ...
    """
    running = Driving(lines, name, listen_only, publish, wait_for_buses, bus_names)
    running.start()
    try:
        if wait:
            running.wait()
        yield running
    finally:
        running.stop()


class EmulatedSkin:
    """A driver that runs on emulated devices in this process.

    Attributes:
        driver: the running driver.
        reader: reads it.
        hardware: the devices; touch them only within ``driver.do``. None: they are on a serial line, or a bus of yours.
        bus: the bus; it can ``vanish`` and ``come_back``, also only within ``driver.do``.
    """

    def __init__(self, driver: Driving, reader: DriverReader, bus: Bus, hardware: EmulatedHardware | None) -> None:
        self.driver = driver
        self.reader = reader
        self.bus = bus
        self.hardware = hardware


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
    """Run a driver on emulated devices, or on a bus of your own.

    Args:
        driver: its registered name, or its class.
        emulator: a class; by default the one registered under the driver's name, unless there is a ``bus``. Those of
            serial drivers get a pseudo terminal.
        name: of the driver in the namespace.
        driver_options: options of the driver.
        bus: a bus' name (``vcan0``, a pseudo terminal). Without ``emulator``, the devices are there already; with it,
            they are brought there.
        emulator_options: options of the devices.
    """
    driver_class = load_driver(driver) if isinstance(driver, str) else driver
    adapter = driver_class(msgspec.convert(dict(driver_options or {}), driver_class.Options, strict=False))
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
            hardware = factory(msgspec.convert(emulator_options, factory.Options, strict=False))
            line = VirtualCanBus.with_hardware(hardware, payload_size=adapter.payload_size)
        driving = running.enter_context(driving_lines([(adapter, line)], name))
        reader = running.enter_context(DriverReader(name, timeout_s=_LONGEST_S))
        yield EmulatedSkin(driving, reader, line, hardware)
