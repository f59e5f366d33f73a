"""Which drivers run on this machine, and on which buses: nobody may send behind a driver's back."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import parse_qsl

from skinware.driver_service import DriverReader
from skinware.errors import BadServiceFile, BusNotAvailable, ConfigurationError, NamespaceError, ServiceNotFound
from skinware.memory.namespace import ROOT, Namespace
from skinware_drivers.registry import parse_bus_name
from skinware_drivers.serial.opening import SerialOptions, find_port

_PREFIX = "skinware."
_PRIVATE = "virtual"
_PLACING: dict[str, dict[str, str]] = {
    "serial": {"serial_number": "", "vid_pid": ""},
    "udp_multicast": {"port": "43113"},
    "socketcand": {"host": "", "port": ""},
}
"""By interface: options that say, beside the channel, which bus it is; and what they are unless given."""


@dataclass(frozen=True)
class RunningDriver:
    """A driver whose process lives.

    Attributes:
        name: under which programs find it.
        namespace: where.
        driver_type: ``roboskin``.
        pid: of its process.
        buses: as it was told them.
    """

    name: str
    namespace: str
    driver_type: str
    pid: int
    buses: tuple[str, ...]

    def bus_named(self, bus_name: str) -> str | None:
        """Its own name for a bus, None if it has no such bus."""
        return next((own for own in self.buses if same_bus(own, bus_name)), None)

    def __str__(self) -> str:
        return f"driver {self.name!r} (namespace {self.namespace}, pid {self.pid})"


def running_drivers() -> list[RunningDriver]:
    """All living drivers in namespaces that this user may read."""
    found = []
    for folder in sorted(ROOT.glob(f"{_PREFIX}*")):
        try:
            namespace = Namespace(folder.name.removeprefix(_PREFIX))
            services = namespace.services()
        except (ConfigurationError, NamespaceError, NotADirectoryError):
            continue
        for name in services:
            driver = _look_at(namespace, name)
            if driver is not None:
                found.append(driver)
    return found


def driver_on(bus_name: str, drivers: Iterable[RunningDriver]) -> RunningDriver | None:
    """The driver that has a bus."""
    return next((driver for driver in drivers if driver.bus_named(bus_name) is not None), None)


def same_bus(one: str, other: str) -> bool:
    """Whether two names mean one bus: links are followed, and only those options count that say where the bus is.

    Serial lines that are named by their USB device are where that is plugged in now; while it is not plugged in, the
    names alone are compared. A ``virtual`` bus is nobody else's: each process has its own.
    """
    place = _place(one)
    return place == _place(other) and place[0] != _PRIVATE


def _place(bus_name: str) -> tuple[str, ...]:
    address, _, query = bus_name.partition("?")
    interface, channel, _ = parse_bus_name(address)
    options = dict(parse_qsl(query))  # of any program's bus: whatever stands there is no error
    placing = {key: options.get(key, usual) for key, usual in _PLACING.get(interface, {}).items()}
    if interface == "serial" and not channel:
        device = SerialOptions(serial_number=placing["serial_number"], vid_pid=placing["vid_pid"])
        with contextlib.suppress(BusNotAvailable, ConfigurationError):
            channel, placing = find_port("", device), dict.fromkeys(placing, "")
    return interface, os.path.realpath(channel) if channel.startswith("/dev/") else channel, *placing.values()


def _look_at(namespace: Namespace, name: str) -> RunningDriver | None:
    try:
        with DriverReader(name, namespace=namespace, announce=False) as reader:
            if not reader.alive:
                return None
            return RunningDriver(name, namespace.name, reader.driver_type, reader.writer_pid, reader.structure.buses)
    except (BadServiceFile, ConfigurationError, NamespaceError, ServiceNotFound):
        return None  # no driver, just withdrawn, or nothing that may be read
