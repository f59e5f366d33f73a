"""Find the bus and the driver that a command line names."""

from __future__ import annotations

from functools import partial
from typing import Any

from skinware.errors import ConfigurationError
from skinware.text import nearest_name
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import CHOOSE, Bus, chosen_by
from skinware_drivers.bus_names import BusName, parse_bus_name
from skinware_drivers.loading import ClassKind, load, registered

DRIVERS = "skinware.drivers"
TRANSPORTS = "skinware.transports"
DEFAULT_DRIVER = "roboskin"

_DRIVER = ClassKind("driver", DRIVERS, "CanAdapter", lambda found: issubclass(found, Adapter))


class NamedBus:
    """A bus that is named and not made yet.

    Args:
        text: ``[interface:]channel[?key=value&...]``.
        driver: the driver whose devices the bus ``virtual`` emulates, if ``text`` names none; registered, or a file.

    Attributes:
        name: the same in its parts.

    Raises:
        ConfigurationError: the name has a mistake, or there is no such interface.
    """

    def __init__(self, text: str, driver: str = DEFAULT_DRIVER) -> None:
        self.text = text
        self.name: BusName = parse_bus_name(text)
        interface, channel, _ = self.name
        self._channel = channel or driver if interface == "virtual" else channel
        self._transport = _transport(text, self.name)

    def choose(self, driver: type[AnyAdapter]) -> type[AnyAdapter]:
        """Return the class of a driver that fits the bus: some devices can be attached to several kinds of bus.

        Where the channel determines the kind of bus, that is looked at: an emulator, a recording.

        Raises:
            ConfigurationError: there is no such channel.
        """
        if not driver.elsewhere:
            return driver
        choose_class = getattr(self._transport, CHOOSE, None)
        bus: type[Bus] = choose_class(self._channel, self.name.options) if choose_class else self._transport
        return next((one for one in (driver, *driver.elsewhere) if bus.fits(one.medium)), driver)

    def make(self, *, payload_size: int = 8, listen_only: bool = False, for_devices: bool = False) -> Bus:
        """Return the bus, not opened yet.

        Args:
            payload_size: longest payload that the layout knows.
            for_devices: the end to which emulated devices are attached, where that is another.

        Raises:
            ConfigurationError: an option is unknown or has a bad value.
        """
        make = self._transport
        if for_devices:
            make = getattr(make, "device_end", None) or make
        bus: Bus = make(self._channel, self.name.options, payload_size=payload_size, listen_only=listen_only)
        return bus


def make_bus(
    name: str,
    *,
    payload_size: int = 8,
    listen_only: bool = False,
    driver: str = DEFAULT_DRIVER,
    for_devices: bool = False,
) -> Bus:
    """Return the bus of a name, not opened yet; the arguments are those of :class:`NamedBus` and its ``make``.

    Raises:
        ConfigurationError: the name has a mistake, there is no such interface, or an option is wrong.
    """
    bus = NamedBus(name, driver)
    return bus.make(payload_size=payload_size, listen_only=listen_only, for_devices=for_devices)


def load_driver(name: str) -> type[AnyAdapter]:
    """Return the driver class of a name; see :func:`skinware_drivers.loading.load`.

    Raises:
        ConfigurationError: there is none of that name, or it cannot be loaded.
    """
    return load(_DRIVER, name)


def _transport(text: str, name: BusName) -> Any:
    """Return what makes the bus: its class, or a function that is marked with ``chosen_by``."""
    transports = registered(TRANSPORTS)
    if name.interface in transports:
        return transports[name.interface].load()
    import can

    python_can = name.interface.removeprefix("can+")
    if python_can not in can.VALID_INTERFACES:
        known = sorted({*transports, *can.VALID_INTERFACES})
        host = name.channel.partition("?")[0].isdecimal()
        network = f"; of a device behind a network, tcp://{text}" if host else ""
        raise ConfigurationError(
            f"bus {text!r}: no interface {name.interface!r}{nearest_name(name.interface, known)}{network}"
        )
    from skinware_drivers.can.pythoncan import PythonCanBus

    return chosen_by(lambda *_: PythonCanBus)(partial(PythonCanBus, python_can))
