"""Contacts beside the drivers that are looked at: found, followed, and where they are on the skin."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from skinware.errors import (
    BadServiceFile,
    ConfigurationError,
    Overrun,
    ServiceNotFound,
    ServiceTimeout,
    StructureError,
)
from skinware.memory.namespace import Namespace
from skinware.structure import Structure
from skinware.tactile.contacts import Contact
from skinware.tactile.contacts_service import ContactsFrame, ContactsReader


class TouchedPlace(NamedTuple):
    """A contact, and where it is on the skin.

    Attributes:
        contact: it.
        unit: of its load.
        sensor: position in a frame of the driver of the taxel nearest to its centre; of one of its taxels, where
            places are not known.
        module: name of the module of that taxel.
    """

    contact: Contact
    unit: str
    sensor: int
    module: str


class LiveContacts:
    """The services of contacts in a namespace, followed live.

    Args:
        namespace: where to look.
    """

    def __init__(self, namespace: Namespace) -> None:
        self._namespace = namespace
        self._readers: dict[str, ContactsReader] = {}

    def look(self, names: Iterable[str]) -> None:
        """Look for services of contacts that are new, and for those that went.

        Args:
            names: of the services that there are now; those of drivers may be missing.
        """
        there = set(names)
        for name in self._readers.keys() - there:
            self._drop(name)
        for name in sorted(there - self._readers.keys()):
            try:
                self._readers[name] = ContactsReader(name, namespace=self._namespace)
            except (BadServiceFile, ConfigurationError, ServiceNotFound):
                continue  # another kind of service, or just gone

    def of(self, driver: str) -> ContactsFrame | None:
        """The newest contacts of a driver; None where no service tells any."""
        for name, reader in sorted(self._readers.items()):
            if reader.source.driver == driver:
                return self._newest(name, reader)
        return None

    def close(self) -> None:
        """Detach from all services. Idempotent."""
        for name in list(self._readers):
            self._drop(name)

    def _newest(self, name: str, reader: ContactsReader) -> ContactsFrame | None:
        try:
            reader.refresh()
            if reader.structure_changed:
                reader.reattach()
            frame = reader.read(timeout_s=0.0)
        except (ServiceTimeout, Overrun):
            return None  # nothing published yet
        except (ServiceNotFound, BadServiceFile):
            self._drop(name)
            return None
        return None if frame.stale else frame

    def _drop(self, name: str) -> None:
        self._readers.pop(name).close()


def places_of(frame: ContactsFrame | None, structure: Structure) -> list[TouchedPlace]:
    """Where the contacts are, the oldest first; none if they are of other sensors than those of the driver.

    Args:
        frame: the contacts; None: there are none.
        structure: of their driver now.
    """
    if frame is None:
        return []
    source = frame.source
    try:
        sensors = np.arange(structure.n_sensors)[structure.index(source.type_name)]
    except StructureError:
        return []
    if not np.array_equal(structure.sensor_uid[sensors], source.uid):
        return []
    found = []
    for contact in frame:
        of_contact = sensors[contact.taxels]
        sensor = int(of_contact[_nearest(contact, of_contact, structure)])
        found.append(
            TouchedPlace(contact, source.unit, sensor, structure.module_names[structure.sensor_module[sensor]])
        )
    return found


def _nearest(contact: Contact, sensors: np.ndarray[Any, Any], structure: Structure) -> int:
    """Which of the contact's sensors is nearest to its centre; the first where nobody knows."""
    if structure.geometry is None:
        return 0
    away_m = np.linalg.norm(structure.geometry.position_m[sensors] - contact.cop_m, axis=1)
    return int(np.nan_to_num(away_m, nan=np.inf).argmin())
