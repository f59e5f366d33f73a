"""Follow the services beside drivers: calm, contacts, motion, and bridges."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from skinware.bridge_state import BridgeReader, BridgeSample, BridgeState
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import BadServiceFile, ConfigurationError, Overrun, ServiceNotFound, ServiceTimeout, StructureError
from skinware.memory.namespace import Namespace
from skinware.memory.ring import SampleT
from skinware.realtime import now_ns
from skinware.service import ServiceReader
from skinware.structure import Structure
from skinware.tactile.contacts import Contact
from skinware.tactile.contacts_service import ContactsReader, ContactsSample
from skinware.tactile.motion_service import MotionReader, MotionSample
from skinware.tactile.source_service import SourceReader
from skinware.views.live import LiveDriver, LiveDrivers

ReaderT = TypeVar("ReaderT", bound=ServiceReader[Any])


class LiveServices(Generic[ReaderT, SampleT]):
    """The services of one kind in one namespace.

    Args:
        namespace: where to look.
        reader: class of the readers of this kind; attaching to a service of another one raises
            :class:`skinware.errors.BadServiceFile`.
    """

    def __init__(self, namespace: Namespace, reader: Callable[..., ReaderT]) -> None:
        self._namespace, self._reader = namespace, reader
        self._readers: dict[str, ReaderT] = {}

    def look(self, names: Iterable[str]) -> None:
        """Look for services of the kind that are new, and for those that went.

        Args:
            names: of the services that there are now; those of drivers may be missing.
        """
        there = set(names)
        for name in self._readers.keys() - there:
            self._drop(name)
        for name in there - self._readers.keys():
            try:
                self._readers[name] = self._reader(name, namespace=self._namespace)
            except (BadServiceFile, ConfigurationError, ServiceNotFound):
                continue  # another kind of service, or just gone
        self._readers = dict(sorted(self._readers.items()))

    def close(self) -> None:
        for name in list(self._readers):
            self._drop(name)

    def _newest(self, name: str) -> SampleT | None:
        """What a service of a living writer told last; None where there is nothing."""
        reader = self._readers[name]
        try:
            reader.refresh()
            if reader.structure_changed:
                reader.reattach()
            frame: SampleT = reader.read(timeout_s=0.0)
        except (ServiceTimeout, Overrun):
            return None  # nothing published yet
        except (ServiceNotFound, BadServiceFile):
            self._drop(name)
            return None
        return None if frame.stale else frame

    def _drop(self, name: str) -> None:
        self._readers.pop(name).close()


class LiveBridges(LiveServices[BridgeReader, BridgeSample]):
    """What the bridges of a namespace tell of themselves.

    Args:
        namespace: where to look.
    """

    def __init__(self, namespace: Namespace) -> None:
        super().__init__(namespace, BridgeReader)

    def states(self) -> list[BridgeState]:
        frames = [self._newest(name) for name in list(self._readers)]
        return [frame.state for frame in frames if frame is not None]


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


_PATIENCE_NS = 20_000_000
"""What is calm of a frame comes soon after it, or not at all."""


class Beside:
    """The services beside the drivers of a namespace: in it, and in the namespace of calmed drivers.

    Args:
        drivers: of the namespace.
        names: of the drivers that count; default: all.
        calm: namespace where calmed drivers are; None: nowhere.
    """

    def __init__(self, drivers: LiveDrivers, names: Collection[str] = (), calm: Namespace | None = None) -> None:
        self._calm = None if calm is None else LiveDrivers(calm, names)
        self._places = [drivers, *([self._calm] if self._calm is not None else [])]
        self._contacts = [live_contacts(place.namespace) for place in self._places]
        self._motion = [live_motion(place.namespace) for place in self._places]
        self._others: list[tuple[str, ...]] = []

    def look(self) -> None:
        """Look for what came and went.

        Raises:
            NamespaceError: the namespace of calmed drivers cannot be trusted or read.
        """
        if self._calm is not None:
            self._calm.look()
        others = [place.others for place in self._places]
        if others != self._others:
            self._others = others
            for contacts, motion, names in zip(self._contacts, self._motion, others, strict=True):
                contacts.look(names)
                motion.look(names)

    def is_due(self, live: LiveDriver) -> bool:
        """Whether the newest frame of a driver may be shown: what is calm of it is here, or will not come."""
        frame, calm = live.frame, self._calm_of(live.name)
        if frame is None or calm is None or self._calm is None:
            return frame is not None
        self._calm.poll(calm)
        is_here = calm.frame is not None and calm.frame.acquired_ns >= frame.acquired_ns
        return is_here or now_ns() - frame.published_ns > _PATIENCE_NS

    def calm_of(self, driver: str) -> DriverSnapshot | None:
        """The newest frame of a calmed driver; None where there is none, or nobody calms it any more."""
        calm = self._calm_of(driver)
        return None if calm is None or calm.frame is None or calm.frame.stale else calm.frame

    def contacts_of(self, driver: str) -> ContactsSample | None:
        """The newest contacts on a driver; None where nobody tells any."""
        return next((frame for source in self._contacts if (frame := source.of(driver)) is not None), None)

    def motion_of(self, driver: str) -> MotionSample | None:
        """The newest motion over the regions of a driver; None where nobody tells any."""
        return next((frame for source in self._motion if (frame := source.of(driver)) is not None), None)

    def close(self) -> None:
        for contacts, motion in zip(self._contacts, self._motion, strict=True):
            contacts.close()
            motion.close()
        if self._calm is not None:
            self._calm.close()

    def _calm_of(self, driver: str) -> LiveDriver | None:
        return None if self._calm is None else self._calm.get(driver)
