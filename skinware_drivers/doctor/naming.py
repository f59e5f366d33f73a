"""Names of buses as people read them, and commands with names filled in."""

from __future__ import annotations

import shlex
from collections.abc import Iterable

from skinware_drivers.bus_names import place_of_bus


def brief(bus_name: str) -> str:
    """A bus' name without options, which make it long."""
    return bus_name.partition("?")[0]


def typed(commands: Iterable[str], bus_name: str, driver: str = "") -> tuple[str, ...]:
    """Commands about a bus, ready to be typed; without those that it cannot have.

    Args:
        commands: with ``{name}`` for the bus, which a ``virtual`` one has in its own process only, ``{channel}`` for
            its CAN interface, and ``{driver}``.
        bus_name: as the driver was told.
        driver: name of the driver.
    """
    interface, channel, _ = place_of_bus(bus_name)
    names = {"driver": shlex.quote(driver)}
    names |= {} if interface == "virtual" else {"name": shlex.quote(brief(bus_name))}
    names |= {"channel": shlex.quote(channel)} if interface == "socketcan" else {}
    return tuple(
        one.format_map(names)
        for one in commands
        if all(f"{{{name}}}" not in one or name in names for name in ("name", "channel"))
    )


__all__ = ["brief", "typed"]
