"""Find the drivers that run on this machine, and their buses, so that no other program sends on these."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

from skinware.driver_service import DriverReader
from skinware.drivers import Drivers
from skinware.errors import BusNotAvailable, ConfigurationError, NamespaceError
from skinware.memory.namespace import ROOT, Namespace
from skinware_drivers.bus_names import BusName, BusPlace
from skinware_drivers.serial.ports import SerialOptions, find_port

_PREFIX = "skinware."
_PRIVATE = "virtual"


@dataclass(frozen=True)
class RunningDriver:
    name: str
    namespace: str
    driver_type: str
    pid: int
    buses: tuple[str, ...]

    def bus_named(self, bus_name: str) -> str | None:
        return next((own for own in self.buses if same_bus(own, bus_name)), None)

    def __str__(self) -> str:
        return f"driver {self.name!r} (namespace {self.namespace}, pid {self.pid})"


def running_drivers() -> list[RunningDriver]:
    found = []
    for folder in sorted(ROOT.glob(f"{_PREFIX}*")):
        with contextlib.suppress(ConfigurationError, NamespaceError):
            namespace = Namespace(folder.name.removeprefix(_PREFIX))
            with Drivers(namespace, partial(DriverReader, announce=False)) as drivers:
                drivers.look()
                found += [
                    RunningDriver(name, namespace.name, reader.driver_type, reader.writer_pid, reader.structure.buses)
                    for name, reader in drivers.readers.items()
                    if reader.alive
                ]
    return found


def driver_on(bus_name: str, drivers: Iterable[RunningDriver]) -> RunningDriver | None:
    return next((driver for driver in drivers if driver.bus_named(bus_name) is not None), None)


def same_bus(one: str, other: str) -> bool:
    """Whether two names, of one program or of two, mean one bus now, by their :class:`BusPlace`.

    Serial lines that are named by their USB device are where that is plugged in now; while it is not plugged in, the
    names alone are compared. A ``virtual`` bus is never the same: each process has its own.
    """
    place = _place_now(one)
    return place == _place_now(other) and place.interface != _PRIVATE


def _place_now(bus_name: str) -> BusPlace:
    place = BusName.of(bus_name).place
    if (place.interface, place.channel) == ("serial", ""):
        with contextlib.suppress(BusNotAvailable, ConfigurationError):
            usb = dict(place.options)
            device = SerialOptions(serial_number=usb["serial_number"], vid_pid=usb["vid_pid"])
            return BusName.of(find_port("", device)).place
    return place
