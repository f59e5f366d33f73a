"""Compute the motion of regions from the velocities of their contacts.

A contact has a velocity of its own (:mod:`skinware.tactile.contacts`). The velocity of a region is the mean over its
contacts, each weighted by its load in the region. So a finger that comes or goes moves nothing, while it would move the
centre of all load.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.tactile.arrays import Arrays, Columns, Doubles, Floats, rows_of
from skinware.tactile.contacts import ContactSet


@dataclass(frozen=True, eq=False)
class RegionMotion:
    """The motion over one region.

    Attributes:
        name: name of the region.
        load: sum of the values of its touched taxels, in the unit of the values.
        contacts: number of contacts that reach into it.
        velocity_m_s: (3,) m/s; NaN where nothing touches it, or no places are known.
        speed_m_s: length of the velocity, m/s.
        frame: name of the coordinate frame, empty if it is not known.
    """

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
    """The motion of all r regions in one frame; a sequence of :class:`RegionMotion`.

    Attributes:
        names: names of the regions.
        load, speed_m_s: (r,) float32.
        contacts: (r,) uint32.
        velocity_m_s: (r, 3) float32.
        frame: (r,) int16, index into ``frames``; -1 if it is not known.
        frames: names of the coordinate frames.
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
    """Return the motion of regions, from the contacts of a frame and (n,) calmed values.

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
