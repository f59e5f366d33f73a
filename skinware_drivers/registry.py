"""Names to things: buses by ``[interface:]channel[?key=value&...]``, drivers and transports by entry point."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import NamedTuple
from urllib.parse import parse_qsl

from skinware.errors import ConfigurationError
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.options import load_registered, nearest_name

DRIVERS = "skinware.drivers"
TRANSPORTS = "skinware.transports"
DEFAULT_DRIVER = "roboskin"


class BusName(NamedTuple):
    """A bus' name taken apart."""

    interface: str
    channel: str
    options: dict[str, str]


def parse_bus_name(name: str) -> BusName:
    """Take a bus' name apart.

    ``vcan0`` is ``socketcan:vcan0``, ``virtual`` an emulated skin in this process. A path, which has a slash in it
    (``/dev/ttyUSB0``, ``./port``), is a serial port; pyserial's URLs (``socket://host:port``) are serial, too.
    python-can's interfaces of names that are ours are ``can+virtual:`` and ``can+serial:``.

    Raises:
        ConfigurationError: empty, or options that are not ``key=value``.
    """
    address, _, query = name.partition("?")
    if "=" in address and "/" not in address:
        raise ConfigurationError(f"bus {name!r}: options begin with a question mark, as in virtual?lose=0.1&seed=1")
    if not address:
        raise ConfigurationError("a bus needs a name, such as vcan0, can0, /dev/ttyUSB0 or virtual")
    try:
        options = dict(parse_qsl(query, keep_blank_values=True, strict_parsing=True)) if query else {}
    except ValueError:
        raise ConfigurationError(f"bus {name!r}: write options as ?key=value&key=value") from None
    interface, colon, channel = address.partition(":")
    if "/" in interface or channel.startswith("//"):  # a path, or one of pyserial's URLs
        interface, channel = "serial", address
    elif not colon:
        interface, channel = (address, "") if address in ("virtual", "pty", "serial") else ("socketcan", address)
    return BusName(interface, channel, options)


def make_bus(name: str, *, payload_size: int = 8, listen_only: bool = False, driver: str = DEFAULT_DRIVER) -> Bus:
    """The bus of a name, not opened yet.

    Args:
        name: ``[interface:]channel[?key=value&...]``.
        payload_size: longest payload that the layout knows.
        listen_only: refuse to send.
        driver: whose devices the bus ``virtual`` emulates, if its name does not say.

    Raises:
        ConfigurationError: no such interface, or a bad option.
    """
    interface, channel, options = parse_bus_name(name)
    if interface == "virtual":
        channel = channel or driver
    transports = {entry.name: entry for entry in entry_points(group=TRANSPORTS)}
    if interface in transports:
        bus_class = transports[interface].load()
        bus: Bus = bus_class(channel, options, payload_size=payload_size, listen_only=listen_only)
        return bus
    import can

    python_can = interface.removeprefix("can+")
    if python_can not in can.VALID_INTERFACES:
        known = sorted({*transports, *can.VALID_INTERFACES})
        raise ConfigurationError(f"bus {name!r}: no interface {interface!r}{nearest_name(interface, known)}")
    from skinware_drivers.can.pythoncan import PythonCanBus

    return PythonCanBus(python_can, channel, options, payload_size=payload_size, listen_only=listen_only)


def load_driver(name: str) -> type[AnyAdapter]:
    """The driver class of a name.

    Raises:
        ConfigurationError: there is none of that name, or it cannot be loaded.
    """
    loaded = load_registered(DRIVERS, "driver", name, f"unknown driver {name!r}")
    if not (isinstance(loaded, type) and issubclass(loaded, Adapter)):
        *_, entry = entry_points(group=DRIVERS, name=name)
        raise ConfigurationError(f"driver {name!r}: {entry.value} is no subclass of CanAdapter or its like")
    return loaded
