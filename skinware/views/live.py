"""All drivers of a namespace, followed live: they come, die, come back changed, and go."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import BadServiceFile, ConfigurationError, Overrun, ServiceNotFound, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.state import SkinHealth, health_of
from skinware.structure import Structure

_LOOK_EVERY_NS = NS_PER_S // 4
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

    def poll(self) -> bool:
        """Take the newest frame if there is a newer one; never waits.

        Returns:
            Whether ``frame`` is another one now.

        Raises:
            ServiceNotFound: the driver was withdrawn just as it had changed.
            BadServiceFile: it came back as something that cannot be read.
        """
        position = self.reader.refresh()
        if self.reader.structure_changed:
            self.reader.reattach()
            position = self.reader.latest
        if position is None or (self.frame is not None and position == self.frame.position):
            return False
        try:
            frame = self.reader.read(timeout_s=0.0)
        except (ServiceTimeout, Overrun):
            return False  # it restarted this very moment, or is too fast; the next poll may be luckier
        self._sample(frame)
        self.frame = frame
        return True

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

    def _sample(self, frame: DriverSnapshot) -> None:
        samples = self._samples
        if self.frame is not None and frame.generation != self.frame.generation:
            samples.clear()
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

    Attributes:
        others: names of the services that are no drivers.
    """

    def __init__(self, namespace: Namespace, names: Collection[str] = ()) -> None:
        self.namespace = namespace
        self._wanted = frozenset(names)
        self.others: tuple[str, ...] = ()
        self._drivers: dict[str, LiveDriver] = {}
        self._next_look_ns = 0

    def get(self, name: str) -> LiveDriver | None:
        return self._drivers.get(name)

    def look(self) -> list[LiveDriver]:
        """All drivers, by name, after looking for new ones and for those that went (four times a second at most).

        Raises:
            NamespaceError: the namespace cannot be trusted or read.
        """
        if now_ns() >= self._next_look_ns:
            self._next_look_ns = now_ns() + _LOOK_EVERY_NS
            names = self.namespace.services()
            for name in [name for name in self._drivers if name not in names]:
                self._drop(name)
            for name in names:
                if name not in self._drivers and (not self._wanted or name in self._wanted):
                    self._attach(name)
            self._drivers = dict(sorted(self._drivers.items()))
            self.others = tuple(name for name in names if name not in self._drivers)
        return list(self._drivers.values())

    def poll(self, driver: LiveDriver) -> bool:
        """``driver.poll()``; one that cannot be read any more is dropped, until it can."""
        try:
            return driver.poll()
        except (ServiceNotFound, BadServiceFile):
            self._drop(driver.name)
            return False

    def close(self) -> None:
        for driver in self._drivers.values():
            driver.reader.close()
        self._drivers = {}

    def _attach(self, name: str) -> None:
        try:
            reader = DriverReader(name, namespace=self.namespace)
        except (BadServiceFile, ConfigurationError, ServiceNotFound):
            return  # no driver (skin-info says what is wrong with it), or just gone
        self._drivers[name] = LiveDriver(reader)

    def _drop(self, name: str) -> None:
        self._drivers.pop(name).reader.close()
