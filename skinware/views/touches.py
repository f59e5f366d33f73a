"""Contacts and motion beside the drivers that are looked at: found, followed, and where contacts are on the skin."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from skinware.errors import StructureError
from skinware.memory.namespace import Namespace
from skinware.memory.ring import SampleT
from skinware.structure import Structure
from skinware.tactile.contacts import Contact
from skinware.tactile.contacts_service import ContactsReader, ContactsSample
from skinware.tactile.motion_service import MotionReader, MotionSample
from skinware.tactile.source_reader import SourceReader
from skinware.views.live_services import LiveServices


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


class LiveSources(LiveServices[SourceReader[Any, SampleT], SampleT]):
    """The services of one kind that tell something of drivers, in one namespace, followed live."""

    def of(self, driver: str) -> SampleT | None:
        """What was told last of a driver; None where no service tells anything."""
        for name, reader in self._readers.items():
            if reader.source.driver == driver:
                return self._newest(name)
        return None


def live_contacts(namespace: Namespace) -> LiveSources[ContactsSample]:
    return LiveSources(namespace, ContactsReader)


def live_motion(namespace: Namespace) -> LiveSources[MotionSample]:
    """The services of motion over regions in a namespace."""
    return LiveSources(namespace, MotionReader)


def places_of(frame: ContactsSample | None, structure: Structure) -> list[TouchedPlace]:
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
