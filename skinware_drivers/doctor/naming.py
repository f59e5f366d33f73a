"""Names of buses as people read them, and commands with names filled in."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

from skinware.errors import ConfigurationError
from skinware_drivers.bus_names import place_of_bus
from skinware_drivers.operations import operations_of
from skinware_drivers.registry import load_driver


def brief(bus_name: str) -> str:
    """A bus' name without options, which make it long."""
    return bus_name.partition("?")[0]


def _placed(bus_name: str) -> str:
    address, _, query = bus_name.partition("?")
    placing = dict(place_of_bus(bus_name).options)
    kept = "&".join(part for part in query.split("&") if part.partition("=")[0] in placing)
    return f"{address}?{kept}" if kept else address


def typed(commands: Iterable[str], bus_name: str, driver: str = "") -> tuple[str, ...]:
    """Commands about a bus, ready to be typed; without those that it cannot have.

    Args:
        commands: with ``{name}`` for the bus (emulated and replayed ones are in the process of their driver only),
            ``{channel}`` for its CAN interface, and ``{driver}``.
        bus_name: as the driver was told.
        driver: name of the driver.
    """
    interface, channel, _ = place_of_bus(bus_name)
    names = {"driver": shlex.quote(driver)}
    names |= {} if interface in ("virtual", "replay") else {"name": shlex.quote(_placed(bus_name))}
    names |= {"channel": shlex.quote(channel)} if interface == "socketcan" else {}
    return tuple(
        one.format_map(names)
        for one in commands
        if all(f"{{{name}}}" not in one or name in names for name in ("name", "channel"))
    )


def has_operation(driver_type: str, operation: str) -> bool:
    """Whether drivers of a type have an operation for skin-config; False for a type that is not installed here."""
    try:
        return operation in operations_of(load_driver(driver_type), alone=True)
    except ConfigurationError:
        return False
