"""What ``skin-driver`` takes from a recording where a bus is ``replay:FILE``: the driver, and what it was told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skinware_drivers.virtual.recorded import Recorded


def driver_of_recording(bus_names: Sequence[str]) -> str:
    found = (recorded.driver_type for recorded in map(_recorded, bus_names) if recorded is not None)
    return next(filter(None, found), "")


def only_listened(bus_names: Sequence[str]) -> bool:
    """Whether the wires of drivers were recorded that sent nothing."""
    found = [_recorded(name) for name in bus_names]
    return bool(found) and all(recorded is not None and recorded.listen_only for recorded in found)


def options_of_recording(bus_name: str, driver_type: str) -> Mapping[str, Any]:
    recorded = _recorded(bus_name)
    return recorded.options if recorded is not None and recorded.driver_type == driver_type else {}


def _recorded(bus_name: str) -> Recorded | None:
    """What a recording tells; None: the bus is none."""
    if not bus_name.startswith("replay:"):
        return None
    from skinware_drivers.virtual.recorded import recorded_driver

    return recorded_driver(bus_name)
