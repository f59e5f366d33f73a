"""Compute, publish and read the motion of regions, by the velocities of their contacts.

The velocity of a region is the mean over its contacts, each weighted by its load in the region. So a finger that comes
or goes moves nothing, while it would move the centre of all load.

Columns of a sample of the service ``motion``: those of :data:`COLUMNS`, a row for each region. Static columns:
``region_name``, ``frame_name``, ``driver``, ``type_name`` and ``type_unit``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.errors import ConfigurationError
from skinware.skin_layout import SkinLayout
from skinware.structure import Structure
from skinware.tactile.arrays import Arrays, Columns, Doubles, Floats, rows_of
from skinware.tactile.contacts import ContactSet
from skinware.tactile.regions import Regions
from skinware.tactile.source_service import (
    ServiceForm,
    ServiceOptions,
    Source,
    SourceReader,
    SourceSample,
    SourceWriter,
)


@dataclass(frozen=True, eq=False)
class RegionMotion:
    """The motion over one region: attributes as of :data:`COLUMNS`, with the name of its frame (empty: not known)."""

    name: str
    load: float
    contacts: int
    velocity_m_s: Floats
    speed_m_s: float
    frame: str

    @property
    def direction(self) -> Floats:
        """(3,) of length 1; NaN where nothing moves."""
        length = np.float32(self.speed_m_s if self.speed_m_s > 0 else np.nan)
        return self.velocity_m_s / length


@dataclass(frozen=True, eq=False)
class MotionSet:
    """The motion of all r regions in one sample; a sequence of :class:`RegionMotion`.

    Each of :data:`COLUMNS` is an array (r, ...); ``names`` are those of the regions, ``frames`` those that ``frame``
    counts.
    """

    names: tuple[str, ...]
    load: Floats
    contacts: npt.NDArray[np.uint32]
    velocity_m_s: Floats
    speed_m_s: Floats
    frame: npt.NDArray[np.int16]
    frames: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, row: int) -> RegionMotion:
        row = range(len(self))[row]
        frame = int(self.frame[row])
        return RegionMotion(
            self.names[row],
            self.load[row].item(),
            self.contacts[row].item(),
            self.velocity_m_s[row],
            self.speed_m_s[row].item(),
            self.frames[frame] if frame >= 0 else "",
        )

    def __iter__(self) -> Iterator[RegionMotion]:
        return (self[row] for row in range(len(self)))


COLUMNS: Columns = {
    "load": ("<f4", (), None, "sum of the values of its touched sensors"),
    "contacts": ("<u4", (), "", "number of contacts that reach into it"),
    "velocity_m_s": ("<f4", (3,), "m/s", "mean velocity of its contacts; NaN: none is known"),
    "speed_m_s": ("<f4", (), "m/s", "length of it"),
    "frame": ("<i2", (), "", "row of frame_name; -1: not known"),
}
"""Dtype, shape, unit (None: that of the values) and meaning, per region, of each array of a :class:`MotionSet`."""


def motion_of(regions: Mapping[str, Index], contacts: ContactSet, value: npt.NDArray[Any]) -> MotionSet:
    """Return the motion of regions, from the contacts of a sample and (n,) calmed values.

    The velocity of a region leaves out contacts in other coordinate frames than the one with most of its load. Regions
    are, by name, positions among the n taxels: a slice or (m,) int64, as :meth:`.Regions.of` gives them.
    """
    columns = rows_of(COLUMNS, len(regions))
    found: Arrays = {name: np.zeros(shape, dtype) for name, (dtype, shape, *_) in columns.items()}
    for row, index in enumerate(regions.values()):
        contact = contacts.contact_of[index]
        touched = contact >= 0
        of_taxel = np.nan_to_num(np.maximum(value[index][touched], 0), posinf=0.0)
        load = np.bincount(contact[touched], of_taxel, len(contacts)).astype(np.float64)
        reach = np.bincount(contact[touched], minlength=len(contacts)) > 0
        velocity, frame = _velocity(contacts, load)
        found["load"][row], found["contacts"][row] = load.sum(), np.count_nonzero(reach)
        found["velocity_m_s"][row], found["speed_m_s"][row] = velocity, np.linalg.norm(velocity)
        found["frame"][row] = frame
    return MotionSet(names=tuple(regions), frames=contacts.frames, **found)


def _velocity(contacts: ContactSet, load: Doubles) -> tuple[Doubles, int]:
    moving = np.flatnonzero((load > 0) & (contacts.frame >= 0))
    if not len(moving):
        return np.full(3, np.nan), -1
    frame = int(np.argmax(np.bincount(contacts.frame[moving], load[moving])))
    moving = moving[contacts.frame[moving] == frame]
    weight = load[moving] / load[moving].sum()
    return weight @ contacts.velocity_m_s[moving], frame


NAME = "motion"

_FORM = ServiceForm(
    NAME, ("driver", "type_name", "unit", "frames", "regions"), lambda source: rows_of(COLUMNS, len(source.regions))
)


class MotionSample(SourceSample):
    """The motion of all regions in one sample; iterate over it for each of them."""

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
        """Publish the motion of the next sample, by its contacts and (n,) calmed values.

        Raises as ``begin``.
        """
        found = motion_of(self._index, contacts, value)
        columns = self.begin()
        for name in COLUMNS:
            columns[name][:] = getattr(found, name)
        self.commit(acquired_ns)
        return found
