"""Contacts and motion beside the drivers that are looked at: found, followed, and where contacts are on the skin."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Generic, NamedTuple

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
from skinware.memory.ring import FrameT
from skinware.structure import Structure
from skinware.tactile.contacts import Contact
from skinware.tactile.contacts_service import ContactsFrame, ContactsReader
from skinware.tactile.motion_service import MotionFrame, MotionReader
from skinware.tactile.source_reader import SourceReader


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


class LiveSources(Generic[FrameT]):
    """The services of one kind that tell something of drivers, in one namespace, followed live.

    Args:
        namespace: where to look.
        reader: class of the readers of this kind.
    """

    def __init__(self, namespace: Namespace, reader: type[SourceReader[Any, FrameT]]) -> None:
        self._namespace, self._reader = namespace, reader
        self._readers: dict[str, SourceReader[Any, FrameT]] = {}

    def look(self, names: Iterable[str]) -> None:
        """Look for services of the kind that are new, and for those that went.

        Args:
            names: of the services that there are now; those of drivers may be missing.
        """
        there = set(names)
        for name in self._readers.keys() - there:
            self._drop(name)
        for name in sorted(there - self._readers.keys()):
            try:
                self._readers[name] = self._reader(name, namespace=self._namespace)
            except (BadServiceFile, ConfigurationError, ServiceNotFound):
                continue  # another kind of service, or just gone

    def of(self, driver: str) -> FrameT | None:
        """What was told last of a driver; None where no service tells anything."""
        for name, reader in sorted(self._readers.items()):
            if reader.source.driver == driver:
                return self._newest(name, reader)
        return None

    def close(self) -> None:
        """Detach from all services. Idempotent."""
        for name in list(self._readers):
            self._drop(name)

    def _newest(self, name: str, reader: SourceReader[Any, FrameT]) -> FrameT | None:
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


def live_contacts(namespace: Namespace) -> LiveSources[ContactsFrame]:
    """The services of contacts in a namespace."""
    return LiveSources(namespace, ContactsReader)


def live_motion(namespace: Namespace) -> LiveSources[MotionFrame]:
    """The services of motion over regions in a namespace."""
    return LiveSources(namespace, MotionReader)


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
