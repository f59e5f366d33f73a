"""All drivers of a namespace, followed live: they come, die, come back changed, and go."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.drivers import Drivers
from skinware.errors import NamespaceError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.state import SkinHealth, health_of
from skinware.structure import Structure

_RATE_WINDOW_NS = 2 * NS_PER_S
_SAMPLE_EVERY_NS = NS_PER_S // 10


class _Sample(NamedTuple):
    """One frame: when it was published, its number, and (n_patches,) how often modules of each patch were updated."""

    time_ns: int
    sequence: int
    updates: npt.NDArray[np.int64]


class LiveDriver:
    """One driver and its newest frame.

    Attributes:
        reader: its reader.
        frame: its newest frame; None before the first.
    """

    def __init__(self, reader: DriverReader) -> None:
        self.reader = reader
        self.frame: DriverSnapshot | None = None
        self._samples: deque[_Sample] = deque()  # of one generation

    @property
    def name(self) -> str:
        return self.reader.name

    @property
    def structure(self) -> Structure:
        """Of its newest frame; before the first of the service."""
        return self.reader.structure if self.frame is None else self.frame.structure

    @property
    def rate_hz(self) -> float | None:
        """Frames per second over the last two seconds; shortly after a start, over the frames in the ring."""
        passed_s = self._passed_s
        if not passed_s:
            return self.reader.rate_hz()
        return (self._samples[-1].sequence - self._samples[0].sequence) / passed_s

    @property
    def patch_rates_hz(self) -> list[float | None]:
        """Updates per second of each patch's modules over the last two seconds.

        None shortly after a start, and of a driver that does not count them.
        """
        structure, passed_s = self.structure, self._passed_s
        if not passed_s or not self._samples[-1].updates.any():
            return [None] * structure.n_patches
        modules = np.bincount(structure.module_patch, minlength=structure.n_patches)
        updates = self._samples[-1].updates - self._samples[0].updates
        rates: list[float | None] = (updates / np.maximum(modules, 1) / passed_s).tolist()
        return rates

    @property
    def _passed_s(self) -> float:
        """What the samples span, s; 0 if that is too little to tell a rate."""
        passed_ns = self._samples[-1].time_ns - self._samples[0].time_ns if self._samples else 0
        return passed_ns / NS_PER_S if passed_ns >= _RATE_WINDOW_NS // 4 else 0.0

    def health(self) -> SkinHealth:
        return health_of(self.reader, self.frame, self.rate_hz)

    def take(self, frame: DriverSnapshot) -> None:
        """Make a frame the newest one."""
        samples = self._samples
        if self.frame is not None and frame.generation != self.frame.generation:
            samples.clear()
        self.frame = frame
        if samples and frame.published_ns - samples[-1].time_ns < _SAMPLE_EVERY_NS:
            return
        samples.append(
            _Sample(frame.published_ns, frame.sequence, frame.patch_interval_counts.sum(axis=1).astype(np.int64))
        )
        while frame.published_ns - samples[0].time_ns > _RATE_WINDOW_NS:
            samples.popleft()


class LiveDrivers:
    """The drivers that a namespace has now, dead ones among them as long as their last frame can be read.

    Args:
        namespace: where to look.
        names: of the drivers to follow; default: all.
    """

    def __init__(self, namespace: Namespace, names: Collection[str] = ()) -> None:
        self.namespace = namespace
        self._drivers = Drivers(namespace, DriverReader, names or None)
        self._live: dict[str, LiveDriver] = {}

    def get(self, name: str) -> LiveDriver | None:
        return self._live.get(name)

    def look(self) -> list[LiveDriver]:
        """Look for drivers that came or went, if that is due, and return all by name.

        Raises:
            NamespaceError: the namespace cannot be trusted or read.
        """
        self._drivers.look()
        if self._drivers.trouble:
            raise NamespaceError(self._drivers.trouble)
        self._keep()
        return list(self._live.values())

    def poll(self, driver: LiveDriver) -> bool:
        """Take the newest frame of a driver; return whether there was a newer one. It never waits."""
        frame = self._drivers.newest(driver.name, newer_than=driver.frame)
        if frame is not None:
            driver.take(frame)
        else:
            self._keep()
        return frame is not None

    def close(self) -> None:
        self._drivers.close()
        self._live = {}

    def _keep(self) -> None:
        readers = self._drivers.readers
        if [live.reader for live in self._live.values()] != list(readers.values()):
            kept = {id(live.reader): live for live in self._live.values()}
            self._live = {name: kept.get(id(reader)) or LiveDriver(reader) for name, reader in readers.items()}
