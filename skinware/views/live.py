"""Follow drivers live, all or one of them, contacts on them, and bridges."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from typing import Generic, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.bridge_state import BridgeReader, BridgeState
from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.drivers import Drivers
from skinware.errors import (
    BadServiceFile,
    ConfigurationError,
    NamespaceError,
    Overrun,
    ServiceNotFound,
    ServiceTimeout,
    StructureError,
)
from skinware.memory.futex import Word
from skinware.memory.namespace import Namespace
from skinware.memory.ring import SampleT
from skinware.realtime import NS_PER_S
from skinware.service._reader import samples_after, wake_word_of
from skinware.skin import Skin
from skinware.state import DriverReport, report_of
from skinware.structure import Structure
from skinware.tactile.contacts import Contact
from skinware.tactile.contacts_service import ContactsReader, ContactsSample
from skinware.tactile.source_service import SourceReader
from skinware.text import nearest_name

_RATE_WINDOW_NS = 2 * NS_PER_S
_COUNT_EVERY_NS = NS_PER_S // 5
_WAIT_S = 0.1
_SILENT_S = 5.0
_MOST_BETWEEN = 64


class _Count(NamedTuple):
    """When a snapshot was published, its number, and (n_patches,) the updates of the modules of each patch so far."""

    time_ns: int
    sequence: int
    updates: npt.NDArray[np.int64]


class LiveDriver:
    def __init__(self, reader: DriverReader) -> None:
        self.reader = reader
        self.frame: DriverSnapshot | None = None
        self._counts: deque[_Count] = deque()  # of one generation

    @property
    def name(self) -> str:
        return self.reader.name

    @property
    def structure(self) -> Structure:
        """The structure of its newest snapshot, before the first that of the service."""
        return self.reader.structure if self.frame is None else self.frame.structure

    @property
    def wake_word(self) -> tuple[Word, int]:
        """The futex that every snapshot wakes, and its present value; take it before looking for a newer one."""
        return wake_word_of(self.reader)

    @property
    def rate_hz(self) -> float | None:
        """Snapshots per second over the last two seconds; shortly after a start, over those in the ring."""
        passed_s = self._counted_s()
        if not passed_s:
            return self.reader.rate_hz()
        return (self._counts[-1].sequence - self._counts[0].sequence) / passed_s

    @property
    def patch_rates_hz(self) -> list[float | None]:
        """Updates per second of each patch's modules over the last two seconds.

        None shortly after a start, and for a driver that does not count them.
        """
        structure, passed_s = self.structure, self._counted_s()
        if not passed_s or not self._counts[-1].updates.any():
            return [None] * structure.n_patches
        modules = np.bincount(structure.module_patch, minlength=structure.n_patches)
        updates = self._counts[-1].updates - self._counts[0].updates
        rates: list[float | None] = (updates / np.maximum(modules, 1) / passed_s).tolist()
        return rates

    def until(self, newest: DriverSnapshot, after: tuple[int, int] | None) -> list[DriverSnapshot]:
        """Return the snapshots after a position, ``newest`` last; those that the ring still has, of one generation."""
        found: deque[DriverSnapshot] = deque(maxlen=_MOST_BETWEEN)
        with contextlib.suppress(Overrun):
            for snapshot in () if after is None else samples_after(self.reader, after):
                if snapshot.position >= newest.position:
                    break
                found.append(snapshot)
        return [*(snapshot for snapshot in found if snapshot.generation == newest.generation), newest]

    def report(self) -> DriverReport:
        return report_of(self.reader, self.frame, self.rate_hz, self.patch_rates_hz)

    def take(self, frame: DriverSnapshot) -> None:
        counts = self._counts
        if self.frame is not None and frame.generation != self.frame.generation:
            counts.clear()
        self.frame = frame
        if counts and frame.published_ns - counts[-1].time_ns < _COUNT_EVERY_NS:
            return
        updates = frame.patch_interval_counts.sum(axis=1).astype(np.int64)
        counts.append(_Count(frame.published_ns, frame.sequence, updates))
        while frame.published_ns - counts[0].time_ns > _RATE_WINDOW_NS:
            counts.popleft()

    def _counted_s(self) -> float:
        """Return the time between the first and the last count, s; 0 if it is too short to measure a rate."""
        passed_ns = self._counts[-1].time_ns - self._counts[0].time_ns if self._counts else 0
        return passed_ns / NS_PER_S if passed_ns >= _RATE_WINDOW_NS // 4 else 0.0


class LiveDrivers:
    """The drivers of a namespace, dead ones too as long as their last snapshot can be read."""

    def __init__(self, namespace: Namespace, names: Collection[str] = (), *, every_ns: int | None = None) -> None:
        self.namespace = namespace
        self._drivers = Drivers(namespace, DriverReader, names or None, every_ns=every_ns)
        self._all: list[LiveDriver] = []

    def get(self, name: str) -> LiveDriver | None:
        return next((live for live in self._all if live.name == name), None)

    def look(self) -> list[LiveDriver]:
        """Return all drivers, the same list while they are the same."""
        if self._drivers.look():
            self._keep()
        if self._drivers.trouble:
            raise NamespaceError(self._drivers.trouble)
        return self._all

    def poll(self, driver: LiveDriver) -> bool:
        """Take the newest snapshot of a driver, and return whether there was a newer one. It never waits."""
        frame = self._drivers.newest(driver.name, newer_than=driver.frame)
        if frame is not None:
            driver.take(frame)
        else:
            self._keep()
        return frame is not None

    def close(self) -> None:
        self._drivers.close()
        self._keep()

    def _keep(self) -> None:
        readers = self._drivers.readers
        if [live.reader for live in self._all] != list(readers.values()):
            kept = {id(live.reader): live for live in self._all}
            self._all = [kept.get(id(reader)) or LiveDriver(reader) for reader in readers.values()]


class LiveBridges(Drivers[BridgeReader]):
    def states(self) -> list[BridgeState]:
        """Return the states of living bridges, without those that cannot be read (skin-info names them)."""
        states = []
        for sample in map(self.newest, list(self.readers)):
            if sample is not None and not sample.stale:
                with contextlib.suppress(BadServiceFile):
                    states.append(sample.state)
        return states


class LiveSources(Drivers[SourceReader[SampleT]], Generic[SampleT]):
    """The services of one kind in a namespace, each of which is about one driver."""

    def of(self, driver: str) -> SampleT | None:
        """Return the newest sample of the service for a driver; None where no living service has one."""
        for name, reader in self.readers.items():
            if reader.source.driver == driver:
                sample: SampleT | None = self.newest_of_living(name)
                return sample
        return None


class TouchedPlace(NamedTuple):
    """A contact, and its place: the taxel nearest to its centre, or its first where places are not known."""

    contact: Contact
    unit: str
    sensor: int
    module: str


def are_on(frame: ContactsSample, structure: Structure) -> bool:
    """Return whether contacts are on sensors of the structure."""
    try:
        sensors = structure.span(frame.source.type_name)
    except StructureError:
        return False
    return np.array_equal(structure.sensor_uid[sensors], frame.source.uid)


def places_of(frame: ContactsSample | None, structure: Structure) -> list[TouchedPlace]:
    """Return the places of contacts, the oldest first; none if they are of other sensors than the structure's."""
    if frame is None or not are_on(frame, structure):
        return []
    sensors, found = structure.index(frame.source.type_name), []
    for contact in frame:
        own = sensors[contact.taxels]
        nearest = 0
        if structure.geometry is not None:
            away_m2 = ((structure.geometry.position_m[own] - contact.cop_m) ** 2).sum(axis=1)
            nearest = int(np.fmin(away_m2, np.inf).argmin())
        sensor = int(own[nearest])
        module = structure.module_names[structure.sensor_module[sensor]]
        found.append(TouchedPlace(contact, frame.source.unit, sensor, module))
    return found


class Overview:
    """The drivers of a namespace, all or those with some names, the contacts on them, and its bridges."""

    def __init__(self, namespace: Namespace, names: Collection[str] = ()) -> None:
        self.names = names
        self.drivers = LiveDrivers(namespace, names)
        self.contacts = LiveSources[ContactsSample](namespace, ContactsReader)
        self.bridges = LiveBridges(namespace, BridgeReader)

    def look(self) -> list[LiveDriver]:
        """Look for what came or went, take the newest snapshots without waiting, and return all drivers by name."""
        for driver in self.drivers.look():
            self.drivers.poll(driver)
        self.contacts.look()
        self.bridges.look()
        return self.drivers.look()

    @property
    def nothing(self) -> str:
        """The drivers that were looked for, and what else there is: where none of them runs."""
        namespace = self.drivers.namespace
        if not self.names:
            return f"no driver runs in namespace {namespace.name!r}"
        wanted = ", ".join(self.names)
        return f"no driver {wanted} runs in namespace {namespace.name!r}{nearest_name(wanted, namespace.services())}"

    def contacts_on(self, driver: LiveDriver) -> list[TouchedPlace] | None:
        sample = self.contacts.of(driver.name)
        return None if sample is None else places_of(sample, driver.structure)

    def close(self) -> None:
        self.bridges.close()
        self.contacts.close()
        self.drivers.close()


def only_driver(namespace: Namespace, how: str) -> str:
    """Return the name of the only driver that runs; ``how`` to choose one is for the message."""
    with Skin(namespace) as skin:
        drivers = skin.refresh().drivers
    if not drivers:
        raise ServiceNotFound(f"no driver runs in namespace {namespace.name!r}")
    if len(drivers) > 1:
        raise ConfigurationError(f"several drivers run: choose one with {how}: {', '.join(drivers)}")
    return drivers[0]


def reader_of(namespace: Namespace, driver: str | None, how: str) -> DriverReader:
    """Return a reader of a driver, or of the only one that runs; ``how`` to choose one is for the message."""
    return DriverReader(driver or only_driver(namespace, how), namespace=namespace)


def frames_until(reader: DriverReader, is_over: Callable[[], bool]) -> Iterator[DriverSnapshot]:
    """Yield the driver's newest snapshot, and those after it, each once.

    Args:
        is_over: called before each snapshot, and ten times a second while none arrives; True ends it.
    """
    read: Callable[..., DriverSnapshot] = reader.read
    heard_s = time.monotonic()
    while not is_over():
        try:
            snapshot = read(timeout_s=_WAIT_S)
        except ServiceTimeout:
            if time.monotonic() - heard_s > _SILENT_S:
                raise
            continue
        read, heard_s = reader.read_next, time.monotonic()
        yield snapshot


def after(seconds: float) -> Callable[[], bool]:
    end_s = time.monotonic() + seconds
    return lambda: time.monotonic() >= end_s
