"""Select the services of a recording, and the sensors of its drivers, for a conversion."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware._columns import as_index
from skinware.conversion.tables import COLUMNS, Block, DerivedSource, Table, TableSource
from skinware.errors import ConfigurationError
from skinware.tactile.regions import Regions, SensorChoice, unknown
from skinware.transfer.generation import PER_SENSOR


@dataclass(frozen=True)
class Selection:
    """The services and sensors to convert. A choice of sensors leaves out services without sensors.

    Attributes:
        services: names; empty: all.
        types: names of sensor types; empty: all.
        patches: names of patches; empty: all.
        regions: definitions of the regions in ``in_regions``.
        in_regions: names of regions: only sensors in one of them; empty: all.
    """

    services: Collection[str] = ()
    types: Collection[str] = ()
    patches: Collection[str] = ()
    regions: Regions = field(default_factory=lambda: Regions(()))
    in_regions: Collection[str] = ()

    @property
    def sensors(self) -> SensorChoice:
        """The choice of sensors."""
        return SensorChoice(self.types, self.patches, self.regions, self.in_regions)

    def of(self, source: TableSource) -> SelectedSource:
        """Return a source reduced to the selection.

        Raises:
            ConfigurationError: the source has no service, type or patch of a name, or none of the chosen sensors.
        """
        sensors = self.sensors
        structures = [table.structure for table in source.tables if table.structure is not None]
        services = unknown("service", self.services, [table.service for table in source.tables])
        for why in (*services, *sensors.unknown(structures)):
            raise ConfigurationError(f"{source.path}: {why}")
        tables = [table for table in source.tables if not self.services or table.service in self.services]
        if sensors:
            tables = [narrowed for table in tables for narrowed in _narrowed(table, sensors)]
            if not tables:
                raise ConfigurationError(f"{source.path}: no sensor in it is selected")
        return SelectedSource(source, tables)


def _narrowed(table: Table, sensors: SensorChoice) -> Iterator[Table]:
    """Yield a driver's table with the chosen sensors, if it has any of them."""
    if table.structure is not None:
        wanted = sensors.of(table.service, table.structure)
        if wanted.any():
            yield NarrowedTable(table, np.flatnonzero(wanted))


class NarrowedTable(Table):
    """A driver's table with some of its sensors."""

    def __init__(self, table: Table, positions: npt.NDArray[np.int64]) -> None:
        self._table, self._index = table, as_index(positions)
        super().__init__(table.name, table.service, [each.only(self._index) for each in table.generations])
        self.sensor_names = [table.sensor_names[position] for position in positions.tolist()]

    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        for block in self._table.blocks(names):
            for name in PER_SENSOR:
                if COLUMNS + name in block:
                    block[COLUMNS + name] = block[COLUMNS + name][:, self._index]
            yield block


class SelectedSource(DerivedSource):
    """Some tables of a source, and what happened to their services."""

    @property
    def events(self) -> list[dict[str, Any]]:
        """See :class:`skinware.conversion.tables.TableSource`."""
        left_out = {table.service for table in self._source.tables} - {table.service for table in self.tables}
        return [event for event in self._source.events if event.get("service") not in left_out]
