"""Publish and read the service ``motion``: how everything that touches a region of a skin moves, frame by frame.

Columns of a sample: those of :data:`skinware.tactile.motion.COLUMNS`, a row for each region. Static columns:
``region_name``, ``frame_name``, ``driver``, ``type_name`` and ``type_unit``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Unpack

import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.skin_layout import SkinLayout
from skinware.structure import Structure
from skinware.tactile.arrays import rows_of
from skinware.tactile.contacts import ContactSet
from skinware.tactile.motion import COLUMNS, MotionSet, RegionMotion, motion_of
from skinware.tactile.regions import Regions
from skinware.tactile.source_service import (
    ServiceForm,
    ServiceOptions,
    Source,
    SourceReader,
    SourceSample,
    SourceWriter,
)

NAME = "motion"

_FORM = ServiceForm(
    NAME, ("driver", "type_name", "unit", "frames", "regions"), lambda source: rows_of(COLUMNS, len(source.regions))
)


class MotionSample(SourceSample):
    """The motion of all regions in one frame; iterate over it for each of them."""

    __slots__ = ()

    @property
    def motion(self) -> MotionSet:
        """All of it, as arrays."""
        arrays = {name: self.column(name) for name in COLUMNS}
        return MotionSet(names=self.source.regions, frames=self.source.frames, **arrays)

    def __iter__(self) -> Iterator[RegionMotion]:
        return iter(self.motion)


class MotionReader(SourceReader[MotionSample]):
    """Reads the service ``motion``: a :class:`skinware.service.ServiceReader` whose samples are motion.

    Raises:
        BadServiceFile: the service is of another kind.
    """

    form = _FORM
    frame_class = MotionSample


class MotionWriter(SourceWriter):
    """Publishes the motion of regions of a driver, by its contacts, whose coordinate frames have these names.

    Other arguments are as for :class:`skinware.tactile.contacts_service.ContactsWriter`.

    Raises:
        StructureError: the driver has no such sensors.
        ConfigurationError: no region may have any.
    """

    form = _FORM

    def __init__(
        self,
        structure: Structure,
        type_name: str,
        regions: Regions,
        frames: tuple[str, ...],
        *,
        driver: str = "",
        name: str = NAME,
        **options: Unpack[ServiceOptions],
    ) -> None:
        self._index = regions.of(SkinLayout((driver,), (structure,)), type_name)
        if not self._index:
            raise ConfigurationError(f"no region is of {type_name} sensors")
        source = Source(driver, type_name, structure.type(type_name).unit, frames, tuple(self._index))
        super().__init__(source, name, **options)

    def publish(self, contacts: ContactSet, value: npt.NDArray[Any], acquired_ns: int) -> MotionSet:
        """Publish the motion of the next frame, by its contacts and (n,) calmed values.

        Raises as ``begin``.
        """
        found = motion_of(self._index, contacts, value)
        columns = self.begin()
        for name in COLUMNS:
            columns[name][:] = getattr(found, name)
        self.commit(acquired_ns)
        return found
