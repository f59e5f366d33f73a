"""Publish and read the service ``contacts``: what touches a skin, sample by sample, for programs in any language.

Columns of a sample: those of :data:`skinware.tactile.contacts.COLUMNS`, of 64 rows each. ``count`` of them are filled,
the oldest contact first; in the others ``id``, ``n`` and ``kind`` are 0, ``frame`` is -1 and numbers are NaN.
``beyond`` counts the contacts that found no row, ``contact_of`` gives each taxel the row of its contact. Static
columns: ``sensor_uid`` of each taxel, ``frame_name``, and ``driver``, ``type_name`` and ``type_unit`` of the values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.memory.ring import ACQUIRED
from skinware.realtime import NS_PER_S, now_ns
from skinware.structure import Structure
from skinware.tactile.arrays import Columns, Flags, rows_of
from skinware.tactile.contacts import COLUMNS, MOST, Contact, Contacts, ContactSet
from skinware.tactile.onsets import ContactEvent, Events
from skinware.tactile.source_service import (
    ServiceForm,
    ServiceOptions,
    Source,
    SourceReader,
    SourceSample,
    SourceWriter,
)
from skinware.tactile.tracking import TrackingSettings

NAME = "contacts"
_NOTHING = {name: np.nan if dtype == "<f4" else 0 for name, (dtype, *_) in COLUMNS.items()} | {"frame": -1}
"""The values of a row that is empty."""


def _columns_of(source: Source) -> Columns:
    text = "row of the contact of each taxel; -1: none, -2: one for which there was no row"
    return rows_of(COLUMNS, MOST) | {
        "count": ("<u4", (1,), "", "number of rows that are filled"),
        "beyond": ("<u4", (1,), "", "contacts for which there was no row"),
        "contact_of": ("<i2", source.uid.shape, "", text),
    }


_FORM = ServiceForm(NAME, ("driver", "type_name", "unit", "frames", "uid"), _columns_of)


class ContactsSample(SourceSample):
    """The contacts of one sample; iterate over it for each of them, the oldest first."""

    __slots__ = ("_contacts",)

    _contacts: ContactSet

    @property
    def contacts(self) -> ContactSet:
        """All of them, as arrays."""
        if not hasattr(self, "_contacts"):
            filled = slice(0, min(int(self.column("count")[0]), MOST))
            self._contacts = ContactSet(
                contact_of=self.column("contact_of"),
                beyond=int(self.column("beyond")[0]),
                frames=self.source.frames,
                **{name: self.column(name)[filled] for name in COLUMNS},
            )
        return self._contacts

    def __iter__(self) -> Iterator[Contact]:
        return iter(self.contacts)


class ContactsReader(SourceReader[ContactsSample]):
    """Reads the service ``contacts``: a :class:`skinware.service.ServiceReader` whose samples are contacts.

    Raises:
        BadServiceFile: the service is of another kind.
    """

    form = _FORM
    frame_class = ContactsSample

    def events(self, *, timeout_s: float | None = None) -> Iterator[ContactEvent]:
        """Iterate over the events of contacts, as they come.

        Times out, and raises, as :meth:`skinware.service.ServiceReader.in_order`.
        """
        events = Events()
        for sample in self.in_order(timeout_s=timeout_s):
            yield from events.of(sample.contacts, sample.acquired_ns)

    def on(self, taxels: Index, *, above: float = 0.0, within_s: float = 0.0) -> Contact | None:
        """Return the newest contact on some taxels at once; None without any.

        ::

            tip = structure.matrices("pressure")["right hand, index top"]
            if contacts.on(tip, above=20, within_s=0.1):
                stop()

        Args:
            taxels: positions among the sensors of the contacts' type: of a region, or a matrix.
            above: its load is larger than this, in the unit of the values.
            within_s: look at all samples in the ring whose data is at most this old, so that a loop does not miss a
                short touch; 0: only at the newest one, whatever its age.

        Raises:
            Closed: this reader was closed.
        """
        newest = self.latest()
        if newest is None:
            return None
        samples, since_ns = [newest], now_ns() - round(within_s * NS_PER_S)
        for sequence, acquired_ns in reversed(self._ring.times_ns(ACQUIRED) if within_s else []):
            if acquired_ns >= since_ns and sequence < newest.sequence:
                samples += filter(None, [self._ring.copy(sequence)])
        if within_s and newest.acquired_ns < since_ns:
            return None
        return next(filter(None, (sample.contacts.on(taxels, above=above) for sample in samples)), None)


class More(TypedDict, total=False):
    """Arguments of :meth:`.Contacts.update` that may be left out."""

    onset: Flags | None
    clipped: Flags | None
    uncertainty: npt.NDArray[Any] | None
    sigmas: npt.NDArray[Any] | None


class ContactsWriter(SourceWriter):
    """Finds the contacts in a driver's values, and publishes them.

    Args:
        structure: of the driver.
        type_name: which sensors.
        driver: its name, for readers.
        neighbours, tracking, poses: as for :meth:`.Contacts.of`, which also lists the errors.
        name: of the service.
        options: namespace, slots, rate_hz and group, as for :class:`skinware.service.ServiceWriter`.
    """

    form = _FORM

    def __init__(
        self,
        structure: Structure,
        type_name: str = "pressure",
        *,
        driver: str = "",
        neighbours: npt.NDArray[Any] | None = None,
        tracking: TrackingSettings | None = None,
        poses: Mapping[str, npt.ArrayLike] | None = None,
        name: str = NAME,
        **options: Unpack[ServiceOptions],
    ) -> None:
        self._followed_by = tracking, poses
        self._contacts = Contacts.of(structure, type_name, neighbours, *self._followed_by)
        super().__init__(_source(structure, type_name, driver, self._contacts), name, **options)

    def publish(self, value: npt.NDArray[Any], touched: Flags, acquired_ns: int, **more: Unpack[More]) -> ContactSet:
        """Find the contacts of the next sample, and publish them.

        Arguments as of :meth:`.Contacts.update`; raises ConfigurationError as that, and as ``begin``.
        """
        found = self._contacts.update(value, touched, acquired_ns, **more)
        columns, count = self.begin(), len(found)
        for name, nothing in _NOTHING.items():
            columns[name][count:] = nothing
            if count:
                columns[name][:count] = getattr(found, name)
        columns["contact_of"][:] = found.contact_of
        columns["count"][:], columns["beyond"][:] = count, found.beyond
        self.commit(acquired_ns)
        return found

    def go_on(self, structure: Structure, *, neighbours: npt.NDArray[Any] | None = None) -> None:
        """Go on with other sensors, as a new generation. All contacts end.

        Raises:
            StructureError, ConfigurationError: as for a new writer; the old generation then goes on.
            NamespaceError: shared memory is full; the old generation then goes on, too.
        """
        type_name = self.source.type_name
        contacts = Contacts.of(structure, type_name, neighbours, *self._followed_by)
        self._go_on(_source(structure, type_name, self.source.driver, contacts))
        self._contacts = contacts


def _source(structure: Structure, type_name: str, driver: str, contacts: Contacts) -> Source:
    unit, uid = structure.type(type_name).unit, structure.sensor_uid[structure.index(type_name)]
    return Source(driver, type_name, unit, contacts.frames, uid=uid)
