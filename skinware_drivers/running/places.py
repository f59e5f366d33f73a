"""Where a driver's sensors are: what a person gave, or else what the buses or their drivers know."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from skinware.geometry import Geometry
from skinware_drivers.description import SkinTables, uid_on_bus

log: logging.Logger = logging.getLogger("skinware.driver")


def put_in_place(tables: SkinTables, given: Geometry | None, of_buses: Sequence[Geometry | None]) -> SkinTables:
    """The same sensors, at their places; as they are where nobody knows any.

    Args:
        tables: of the driver.
        given: by a person; nothing else counts then.
        of_buses: by the uids that sensors have on their bus, in the order of the driver's buses.
    """
    if given is not None:
        tables = tables.placed(given)
        geometry = tables.structure.geometry
        if geometry is not None and not geometry.known.any():
            log.warning(
                "the geometry has no place for any of the sensors: types and uid in its file are of another skin"
            )
        return tables
    known = [_on_bus(geometry, bus) for bus, geometry in enumerate(of_buses) if geometry is not None]
    placed = tables.placed(Geometry.joined(known)) if known else tables
    geometry = placed.structure.geometry
    return placed if geometry is not None and geometry.known.any() else tables


def _on_bus(geometry: Geometry, bus: int) -> Geometry:
    """With the uids of the whole driver, and a frame for each bus: nobody knows how two of them lie to each other."""
    frames = [f"{frame} {bus + 1}" if bus else frame for frame in geometry.frame.tolist()]
    return replace(geometry, uid=uid_on_bus(bus, geometry.uid), frame=np.array(frames, object))
