"""Some sensors of a skin, by what people call them: their types, patches and regions."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from skinware.skin_layout import SkinLayout
from skinware.structure import Structure
from skinware.tactile.regions import Flags, Regions


@dataclass(frozen=True)
class SensorChoice:
    """Which sensors are wanted: those of which all that follows is true.

    Attributes:
        types: names of sensor types; empty: all.
        patches: names of patches, as people know them; empty: all.
        regions: those that ``in_regions`` names are of.
        in_regions: names of regions: only sensors that are in any of them; empty: all.
    """

    types: Collection[str] = ()
    patches: Collection[str] = ()
    regions: Regions = field(default_factory=lambda: Regions(()))
    in_regions: Collection[str] = ()

    def __bool__(self) -> bool:
        return bool(self.types or self.patches or self.in_regions)

    def unknown(self, structures: Sequence[Structure]) -> Iterator[str]:
        """What of it is not there, a line for people each.

        Args:
            structures: of all drivers there are.
        """
        yield from unknown("sensor type", self.types, [each.name for one in structures for each in one.types])
        yield from unknown("patch", self.patches, [name for one in structures for name in one.patch_names])
        yield from unknown("region", self.in_regions, [region.name for region in self.regions])

    def of(self, driver: str, structure: Structure) -> Flags:
        """(n_sensors,) bool: which sensors of a driver it takes, in frame order.

        Args:
            driver: its name.
            structure: of it.
        """
        wanted = np.zeros(structure.n_sensors, bool)
        for sensor_type in structure.types:
            if not self.types or sensor_type.name in self.types:
                wanted[structure.index(sensor_type.name)] = self._in_regions(driver, structure, sensor_type.name)
        if self.patches:
            numbers = [row for row, name in enumerate(structure.patch_names) if name in self.patches]
            wanted &= np.isin(structure.sensor_patch, numbers)
        return wanted

    def _in_regions(self, driver: str, structure: Structure, type_name: str) -> Flags:
        """(n,) bool: which sensors of a type are in the regions."""
        inside = np.full(len(structure.module_of(type_name)), not self.in_regions)
        if self.in_regions and len(inside):
            found = self.regions.of(SkinLayout((driver,), (structure,)), type_name)
            for name in self.in_regions:
                if name in found:  # others are of sensors of other types
                    inside[found[name]] = True
        return inside


def unknown(what: str, wanted: Collection[str], there_are: Sequence[str]) -> Iterator[str]:
    """A line for people for each of some names that is not there: ``no patch 'palm'; there are: board 7, board 8``."""
    for name in wanted:
        if name not in there_are:
            yield f"no {what} {name!r}; there are: {', '.join(dict.fromkeys(there_are)) or 'none'}"
