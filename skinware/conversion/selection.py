"""What of a recording is converted: some services, and of drivers some sensors."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware._columns import as_index
from skinware.conversion.tables import COLUMNS, Block, DerivedSource, Source, Table
from skinware.errors import ConfigurationError
from skinware.skin_layout import SkinLayout
from skinware.structure import Structure
from skinware.tactile.regions import Regions
from skinware.transfer.generation import PER_SENSOR


@dataclass(frozen=True)
class Selection:
    """What is wanted.

    Attributes:
        services: names; empty: all.
        types: names of sensor types; empty: all. This and what follows is about sensors: services that have none are
            then left out.
        patches: names of patches, as people know them; empty: all.
        regions: those that ``in_regions`` names are of.
        in_regions: names of regions: only sensors that are in any of them; empty: all.
    """

    services: Collection[str] = ()
    types: Collection[str] = ()
    patches: Collection[str] = ()
    regions: Regions = field(default_factory=lambda: Regions(()))
    in_regions: Collection[str] = ()

    @property
    def is_of_sensors(self) -> bool:
        """Whether it takes some sensors only."""
        return bool(self.types or self.patches or self.in_regions)

    def of(self, source: Source) -> SelectedSource:
        """What of a source is wanted.

        Raises:
            ConfigurationError: the source has no service, type or patch of a name, or nothing that is wanted.
        """
        self._check(source)
        tables = [table for table in source.tables if not self.services or table.service in self.services]
        if self.is_of_sensors:
            tables = [narrowed for table in tables for narrowed in self._narrowed(table)]
            if not tables:
                raise ConfigurationError(f"{source.path}: no sensor in it is of what was asked for")
        return SelectedSource(source, tables)

    def _check(self, source: Source) -> None:
        structures = [table.structure for table in source.tables if table.structure is not None]
        for what, wanted, there_are in (
            ("service", self.services, [table.service for table in source.tables]),
            ("sensor type", self.types, [each.name for structure in structures for each in structure.types]),
            ("patch", self.patches, [name for structure in structures for name in structure.patch_names]),
            ("region", self.in_regions, [region.name for region in self.regions]),
        ):
            for name in wanted:
                if name not in there_are:
                    listed = ", ".join(dict.fromkeys(there_are)) or "none"
                    raise ConfigurationError(f"{source.path}: no {what} {name!r}; there are: {listed}")

    def _narrowed(self, table: Table) -> Iterator[Table]:
        structure = table.structure
        if structure is None:
            return
        wanted = np.zeros(structure.n_sensors, bool)
        for sensor_type in structure.types:
            if not self.types or sensor_type.name in self.types:
                wanted[structure.index(sensor_type.name)] = self._in_regions(table.service, structure, sensor_type.name)
        if self.patches:
            numbers = [row for row, name in enumerate(structure.patch_names) if name in self.patches]
            wanted &= np.isin(structure.sensor_patch, numbers)
        if wanted.any():
            yield NarrowedTable(table, np.flatnonzero(wanted))

    def _in_regions(self, driver: str, structure: Structure, type_name: str) -> npt.NDArray[np.bool_]:
        """(n,) bool: which sensors of a type are in the regions."""
        inside = np.full(len(structure.module_of(type_name)), not self.in_regions)
        if self.in_regions and len(inside):
            found = self.regions.of(SkinLayout((driver,), (structure,)), type_name)
            for name in self.in_regions:
                if name in found:  # others are of sensors of other types
                    inside[found[name]] = True
        return inside


class NarrowedTable(Table):
    """A driver's table with some of its sensors.

    Args:
        table: with all of them.
        positions: (n,) of those that stay, in a frame.
    """

    def __init__(self, table: Table, positions: npt.NDArray[np.int64]) -> None:
        self._table, self._index = table, as_index(positions)
        super().__init__(table.name, table.service, [each.only(self._index) for each in table.generations])
        self.sensor_names = [table.sensor_names[position] for position in positions.tolist()]

    def blocks(self, names: Collection[str]) -> Iterator[Block]:
        """See :class:`Table`."""
        for block in self._table.blocks(names):
            for name in PER_SENSOR:
                if COLUMNS + name in block:
                    block[COLUMNS + name] = block[COLUMNS + name][:, self._index]
            yield block


class SelectedSource(DerivedSource):
    """Some tables of a source, and what happened to their services."""

    @property
    def events(self) -> list[dict[str, Any]]:
        """See :class:`skinware.conversion.tables.Source`."""
        left_out = {table.service for table in self._source.tables} - {table.service for table in self.tables}
        return [event for event in self._source.events if event.get("service") not in left_out]
