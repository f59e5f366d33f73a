"""The service ``contacts``: what touches a skin, frame by frame, for programs in any language.

::

    with ContactsReader(namespace="calm", timeout_s=10) as contacts:
        for frame in contacts:
            for contact in frame:
                print(contact.id, contact.load, contact.cop_m, contact.taxels)

Columns of a frame: those of :data:`skinware.tactile.contacts.COLUMNS`, of 64 rows each. ``count`` of them are filled,
the oldest contact first; in the others ``id``, ``n`` and ``kind`` are 0, ``frame`` is -1 and numbers are NaN.
``beyond`` tells how many contacts found no row, ``contact_of`` of each taxel the row of its contact. Static columns:
``sensor_uid`` of each taxel, ``frame_name``, and ``driver``, ``type_name`` and ``type_unit`` of the values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import texts
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.service import Column, ServiceWriter
from skinware.structure import Structure
from skinware.tactile.contacts import COLUMNS, MOST, Contact, Contacts, ContactSet
from skinware.tactile.source_reader import SourceReader

KIND = NAME = "contacts"

_TEXTS = {
    "id": ("", "the same as long as the contact lasts; 0: this row is empty"),
    "age_s": ("s", "since it began"),
    "load": ("", "sum of the values of its taxels"),
    "peak": ("", "the largest of them"),
    "area_m2": ("m2", "that its taxels stand for"),
    "force_n": ("N", "pressure by area; only of pressures in Pa"),
    "n": ("", "number of its taxels"),
    "cop_m": ("m", "its centre, in its frame"),
    "normal": ("", "outwards, of length 1"),
    "velocity_m_s": ("m/s", "of its centre"),
    "frame": ("", "row of frame_name; -1: not known"),
    "kind": ("", "0: a touch, 1: a hold, 2: sliding"),
    "count": ("", "number of rows that are filled"),
    "beyond": ("", "contacts for which there was no row"),
    "contact_of": ("", "row of the contact of each taxel; -1: none, -2: one for which there was no row"),
}
_FLOAT_KIND = "f"


@dataclass(frozen=True)
class ContactsSource:
    """What contacts are of.

    Attributes:
        driver: name of the driver of the values.
        type_name: of its sensors.
        unit: of values, loads and peaks.
        uid: (n,) uint64, of the n taxels.
        frames: names of the coordinate frames.
    """

    driver: str
    type_name: str
    unit: str
    uid: npt.NDArray[np.uint64]
    frames: tuple[str, ...]


class ContactsSample(Sample):
    """The contacts of one frame; going through it goes through them, the oldest first."""

    __slots__ = ("_contacts",)

    _contacts: ContactSet

    @property
    def source(self) -> ContactsSource:
        """What the contacts are of."""
        return cast(ContactsSource, self.context)

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


class ContactsReader(SourceReader[ContactsSource, ContactsSample]):
    """Reads the service ``contacts``: a :class:`skinware.service.ServiceReader` whose frames are contacts.

    Args:
        name: of the service.
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Raises:
        BadServiceFile: the service is none of contacts.
    """

    kind = KIND
    frame_class = ContactsSample

    @staticmethod
    def _source_of(static: Mapping[str, npt.NDArray[Any]]) -> ContactsSource:
        return ContactsSource(
            driver=texts(static["driver"])[0],
            type_name=texts(static["type_name"])[0],
            unit=texts(static["type_unit"])[0],
            uid=static["sensor_uid"].astype(np.uint64),
            frames=tuple(texts(static["frame_name"])),
        )

    @staticmethod
    def _layout_of(source: ContactsSource) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        return _frame_columns(len(source.uid))


class ContactsWriter:
    """Finds the contacts of a driver's values, and publishes them.

    Args:
        structure: of the driver.
        type_name: which sensors.
        driver: its name, told to readers.
        neighbours: (n, k) int, as for :class:`skinware.tactile.contacts.Contacts`; default: from the places that the
            structure has.
        name: of the service.
        namespace, slots, rate_hz, group: as for :class:`skinware.service.ServiceWriter`, which also lists the errors.

    Raises:
        StructureError: the driver has no such sensors.
        ConfigurationError: the neighbours are not of these sensors.
    """

    def __init__(
        self,
        structure: Structure,
        type_name: str = "pressure",
        *,
        driver: str = "",
        neighbours: npt.NDArray[Any] | None = None,
        name: str = NAME,
        namespace: Namespace | str | None = None,
        slots: int | None = None,
        rate_hz: float | None = None,
        group: str | None = None,
    ) -> None:
        self._type_name, self._driver = type_name, driver
        self._contacts = Contacts.of(structure, type_name, neighbours)
        self._service = ServiceWriter(
            name,
            self._columns(structure),
            self._static(structure),
            namespace=namespace,
            kind=KIND,
            slots=slots,
            rate_hz=rate_hz,
            group=group,
            description=f"contacts of {driver or 'a skin'}, {type_name}",
        )

    @property
    def name(self) -> str:
        """Name of the service."""
        return self._service.name

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the coordinate frames that contacts are in."""
        return self._contacts.frames

    def publish(self, value: npt.NDArray[Any], touched: npt.NDArray[np.bool_], acquired_ns: int) -> ContactSet:
        """Find the contacts of the next frame, and publish them.

        Args:
            value: (n,) calmed values of the n sensors; 0 = no touch.
            touched: (n,) bool.
            acquired_ns: of the frame, CLOCK_MONOTONIC ns.

        Raises:
            ConfigurationError: not of these sensors.
            Closed, Paused, NameInUse: as :meth:`skinware.service.ServiceWriter.begin`.
        """
        found = self._contacts.update(value, touched, acquired_ns)
        columns = self._service.begin()
        for name in COLUMNS:
            column = columns[name]
            column[: len(found)] = getattr(found, name)
            column[len(found) :] = np.nan if column.dtype.kind == _FLOAT_KIND else 0
        columns["frame"][len(found) :] = -1
        columns["contact_of"][:] = found.contact_of
        columns["count"][:], columns["beyond"][:] = len(found), found.beyond
        self._service.commit(acquired_ns)
        return found

    def restructure(self, structure: Structure, *, neighbours: npt.NDArray[Any] | None = None) -> None:
        """Go on with other sensors, as a new generation; readers are told. All contacts begin anew.

        Raises:
            StructureError, ConfigurationError: as for a new writer; the old generation then goes on.
            NamespaceError: shared memory is full; likewise.
        """
        before, self._contacts = self._contacts, Contacts.of(structure, self._type_name, neighbours)
        try:
            self._service.restructure(self._columns(structure), self._static(structure))
        except BaseException:
            self._contacts = before
            raise

    def close(self) -> None:
        """Withdraw the service. Idempotent."""
        self._service.close()

    def _columns(self, structure: Structure) -> dict[str, Column]:
        of_values = {name: structure.type(self._type_name).unit for name in ("load", "peak")}
        columns = {}
        for name, (dtype, shape) in _frame_columns(len(structure.module_of(self._type_name))).items():
            unit, description = _TEXTS[name]
            columns[name] = Column(np.dtype(dtype), shape, of_values.get(name, unit), description)
        return columns

    def _static(self, structure: Structure) -> dict[str, npt.NDArray[Any]]:
        sensor_type = structure.type(self._type_name)
        return {
            "sensor_uid": structure.sensor_uid[structure.index(self._type_name)],
            "frame_name": np.array([name.encode() for name in self._contacts.frames], "S64"),
            "driver": np.array([self._driver.encode()], "S64"),
            "type_name": np.array([sensor_type.name.encode()], "S32"),
            "type_unit": np.array([sensor_type.unit.encode()], "S16"),
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _frame_columns(n: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    rows = {name: (dtype, (MOST, *shape)) for name, (dtype, shape) in COLUMNS.items()}
    return rows | {"count": ("<u4", (1,)), "beyond": ("<u4", (1,)), "contact_of": ("<i2", (n,))}
