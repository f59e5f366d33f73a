"""Names to things: a bus and a driver for what the command line says."""

from __future__ import annotations

from skinware.errors import ConfigurationError
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.bus_names import parse_bus_name
from skinware_drivers.loading import Kind, load, registered
from skinware_drivers.options import nearest_name

DRIVERS = "skinware.drivers"
TRANSPORTS = "skinware.transports"
DEFAULT_DRIVER = "roboskin"

_DRIVER = Kind("driver", DRIVERS, "CanAdapter", lambda found: issubclass(found, Adapter))


def make_bus(
    name: str,
    *,
    payload_size: int = 8,
    listen_only: bool = False,
    driver: str = DEFAULT_DRIVER,
    for_devices: bool = False,
) -> Bus:
    """The bus of a name, not opened yet.

    Args:
        name: ``[interface:]channel[?key=value&...]``.
        payload_size: longest payload that the layout knows.
        listen_only: refuse to send.
        driver: whose devices the bus ``virtual`` emulates, if its name does not say; registered, or a file.
        for_devices: the end at which emulated devices are, where that is another.

    Raises:
        ConfigurationError: no such interface, or a bad option.
    """
    interface, channel, options = parse_bus_name(name)
    if interface == "virtual":
        channel = channel or driver
    transports = registered(TRANSPORTS)
    if interface in transports:
        bus_class = transports[interface].load()
        if for_devices:
            bus_class = getattr(bus_class, "device_end", None) or bus_class
        bus: Bus = bus_class(channel, options, payload_size=payload_size, listen_only=listen_only)
        return bus
    import can

    python_can = interface.removeprefix("can+")
    if python_can not in can.VALID_INTERFACES:
        known = sorted({*transports, *can.VALID_INTERFACES})
        host = f"; of a device behind a network, tcp://{name}" if channel.partition("?")[0].isdecimal() else ""
        raise ConfigurationError(f"bus {name!r}: no interface {interface!r}{nearest_name(interface, known)}{host}")
    from skinware_drivers.can.pythoncan import PythonCanBus

    return PythonCanBus(python_can, channel, options, payload_size=payload_size, listen_only=listen_only)


def load_driver(name: str) -> type[AnyAdapter]:
    """The driver class of a name; see :func:`skinware_drivers.loading.load`.

    Raises:
        ConfigurationError: there is none of that name, or it cannot be loaded.
    """
    return load(_DRIVER, name)


def class_for(driver: type[AnyAdapter], bus_name: str, driver_name: str) -> type[AnyAdapter]:
    """The class of a driver for a bus: of devices that are attached to several kinds of bus, that for this kind.

    Args:
        driver: as :func:`load_driver` gives it.
        bus_name: of the bus, as for :func:`make_bus`.
        driver_name: of the driver.

    Raises:
        ConfigurationError: no such bus.
    """
    if not driver.elsewhere:
        return driver
    bus = make_bus(bus_name, driver=driver_name)
    return next((one for one in (driver, *driver.elsewhere) if bus.fits(one.medium)), driver)
