"""Values that no taxel can have: most likely a device sends the bytes of its registers in the other order."""

from __future__ import annotations

import logging

from skinware.status import Status
from skinware_drivers.decoding.skin_state import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.polling import ZeroWatch

log: logging.Logger = logging.getLogger("skinware.driver")


class OrderWatch(ZeroWatch):
    """Also tells what it means that the layout holds values for suspect because they are above all that a taxel tells.

    Args:
        tables: of the skin.
        full_scale: the greatest value of a taxel.
    """

    def __init__(self, tables: SkinTables, full_scale: int) -> None:
        super().__init__(tables)
        self._full_scale = full_scale
        self._has_told_order = False

    def look(self, updates: Updates) -> None:
        super().look(updates)
        is_sensor = updates.sensors < self.tables.structure.n_sensors
        if not self._has_told_order and (updates.status[is_sensor] & Status.SUSPECT).any():
            self._has_told_order = True
            log.warning(
                "values above %d, which no taxel has, are suspect; if there are many, the device may send the bytes of"
                " registers in the other order: add byte_order=little to the options of the bus",
                self._full_scale,
            )
