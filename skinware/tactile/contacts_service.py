"""Publish and read the service ``contacts``: what touches a skin, frame by frame, for programs in any language.

::

    with ContactsReader(namespace="calm", timeout_s=10) as contacts:
        for sample in contacts:
            for contact in sample:
                print(contact.id, contact.load, contact.cop_m, contact.taxels)

Columns of a sample: those of :data:`skinware.tactile.contacts.COLUMNS`, of 64 rows each. ``count`` of them are filled,
the oldest contact first; in the others ``id``, ``n`` and ``kind`` are 0, ``frame`` is -1 and numbers are NaN.
``beyond`` counts the contacts that found no row, ``contact_of`` gives each taxel the row of its contact. Static
columns: ``sensor_uid`` of each taxel, ``frame_name``, and ``driver``, ``type_name`` and ``type_unit`` of the values.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from skinware._columns import Index
from skinware.memory.ring import ACQUIRED
from skinware.realtime import NS_PER_S, now_ns
from skinware.structure import Structure
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

_ABOUT: dict[str, tuple[str | None, str]] = {
    "id": ("", "the same as long as the contact lasts; 0: this row is empty"),
    "age_s": ("s", "since it began"),
    "load": (None, "sum of the values of its taxels"),
    "peak": (None, "the largest of them"),
    "area_m2": ("m2", "that its taxels stand for"),
    "force_n": ("N", "of values in N, or of pressures in Pa by area"),
    "n": ("", "number of its taxels"),
    "cop_m": ("m", "its centre, in its frame"),
    "normal": ("", "outwards, of length 1"),
    "velocity_m_s": ("m/s", "of its centre"),
    "frame": ("", "row of frame_name; -1: not known"),
    "kind": ("", "0: a touch, 1: a hold, 2: sliding"),
    "provisional": ("", "1: only its last frames speak for it, and its load is 0"),
    "clipped": ("", "number of its taxels that are at the end of their range"),
    "load_whole": (None, "estimate of the load with what threshold and clipping cut off; NaN: most of it is"),
    "uncertainty": (None, "how much of the load could be noise or drift; NaN: not known"),
    "count": ("", "number of rows that are filled"),
    "beyond": ("", "contacts for which there was no row"),
    "contact_of": ("", "row of the contact of each taxel; -1: none, -2: one for which there was no row"),
}


def _columns_of(source: Source) -> dict[str, tuple[str, tuple[int, ...]]]:
    forms = {name: (dtype, (MOST, *shape)) for name, (dtype, shape) in COLUMNS.items()}
    return forms | {"count": ("<u4", (1,)), "beyond": ("<u4", (1,)), "contact_of": ("<i2", source.uid.shape)}


_FORM = ServiceForm(NAME, ("driver", "type_name", "unit", "frames", "uid"), _ABOUT, _columns_of)


class ContactsSample(SourceSample):
    """The contacts of one frame; iterate over it for each of them, the oldest first."""

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

    Args:
        name: of the service.
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Raises:
        BadServiceFile: the service is of another kind.
    """

    form = _FORM
    frame_class = ContactsSample

    def events(self, *, timeout_s: float | None = None) -> Iterator[ContactEvent]:
        """Iterate over onsets, confirmations, withdrawals and ends of contacts, as they come.

        Args:
            timeout_s: as for :meth:`skinware.service.ServiceReader.in_order`, which also lists the errors.
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

    onset: npt.NDArray[np.bool_] | None
    clipped: npt.NDArray[np.bool_] | None
    uncertainty: npt.NDArray[Any] | None


class ContactsWriter(SourceWriter):
    """Finds the contacts in a driver's values, and publishes them.

    Args:
        structure: of the driver.
        type_name: which sensors.
        driver: its name, for readers.
        neighbours: (n, k) int, as for :class:`skinware.tactile.contacts.Contacts`; default: from the places that the
            structure has.
        tracking: settings of the tracking.
        name: of the service.
        options: namespace, slots, rate_hz and group, as for :class:`skinware.service.ServiceWriter`, which also lists
            the errors.

    Raises:
        StructureError: the driver has no such sensors.
        ConfigurationError: the neighbours are not of these sensors.
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
        name: str = NAME,
        **options: Unpack[ServiceOptions],
    ) -> None:
        self._tracking = tracking
        self._contacts = Contacts.of(structure, type_name, neighbours, tracking)
        source = _source(structure, type_name, driver, self._contacts)
        super().__init__(source, name, f"contacts of {driver or 'a skin'}, {type_name}", **options)

    def publish(
        self, value: npt.NDArray[Any], touched: npt.NDArray[np.bool_], acquired_ns: int, **more: Unpack[More]
    ) -> ContactSet:
        """Find the contacts of the next frame, and publish them.

        Args:
            value: (n,) calmed values of the n sensors; 0 = no touch.
            touched: (n,) bool.
            acquired_ns: of the frame, CLOCK_MONOTONIC ns.
            more: onset, clipped and uncertainty, as for :meth:`.Contacts.update`.

        Raises:
            ConfigurationError: not of these sensors.
            Closed, Paused, NameInUse: as :meth:`skinware.service.ServiceWriter.begin`.
        """
        found = self._contacts.update(value, touched, acquired_ns, **more)
        columns = self._service.begin()
        for name in COLUMNS:
            column = columns[name]
            column[: len(found)] = getattr(found, name)
            column[len(found) :] = np.nan if column.dtype.kind == "f" else 0
        columns["frame"][len(found) :] = -1
        columns["contact_of"][:] = found.contact_of
        columns["count"][:], columns["beyond"][:] = len(found), found.beyond
        self._service.commit(acquired_ns)
        return found

    def restructure(self, structure: Structure, *, neighbours: npt.NDArray[Any] | None = None) -> None:
        """Go on with other sensors, as a new generation. All contacts end.

        Raises:
            StructureError, ConfigurationError: as for a new writer; the old generation then goes on.
            NamespaceError: shared memory is full; the old generation then goes on, too.
        """
        type_name = self.source.type_name
        contacts = Contacts.of(structure, type_name, neighbours, self._tracking)
        self._restructure(_source(structure, type_name, self.source.driver, contacts))
        self._contacts = contacts


def _source(structure: Structure, type_name: str, driver: str, contacts: Contacts) -> Source:
    unit, uid = structure.type(type_name).unit, structure.sensor_uid[structure.index(type_name)]
    return Source(driver, type_name, unit, contacts.frames, uid=uid)
