"""All drivers of a namespace, followed live: they come, die, come back changed, and go."""

from __future__ import annotations

from collections import deque

from skinware.cli._health import SkinHealth, health_of
from skinware.driver_service import DriverFrame, DriverReader
from skinware.errors import BadServiceFile, ConfigurationError, Overrun, ServiceNotFound, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns

_LOOK_EVERY_NS = NS_PER_S // 4
_RATE_WINDOW_NS = 2 * NS_PER_S
_SAMPLE_EVERY_NS = NS_PER_S // 10


class LiveDriver:
    """One driver and its newest frame.

    Attributes:
        reader: its reader.
        frame: its newest frame; None before the first.
    """

    def __init__(self, reader: DriverReader) -> None:
        self.reader = reader
        self.frame: DriverFrame | None = None
        self._samples: deque[tuple[int, int]] = deque()  # (published_ns, sequence) of one generation

    @property
    def name(self) -> str:
        """Name of the driver."""
        return self.reader.name

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
        if len(self._samples) > 1:
            (first_ns, first), (last_ns, last) = self._samples[0], self._samples[-1]
            if last_ns - first_ns >= _RATE_WINDOW_NS // 4:
                return (last - first) * NS_PER_S / (last_ns - first_ns)
        return self.reader.rate_hz()

    def health(self) -> SkinHealth:
        """The driver in a few figures."""
        return health_of(self.reader, self.frame, self.rate_hz)

    def _sample(self, frame: DriverFrame) -> None:
        samples = self._samples
        if self.frame is not None and frame.generation != self.frame.generation:
            samples.clear()
        if samples and frame.published_ns - samples[-1][0] < _SAMPLE_EVERY_NS:
            return
        samples.append((frame.published_ns, frame.sequence))
        while frame.published_ns - samples[0][0] > _RATE_WINDOW_NS:
            samples.popleft()


class LiveDrivers:
    """The drivers that a namespace has now, dead ones among them as long as their last frame can be read.

    Args:
        namespace: where to look.
    """

    def __init__(self, namespace: Namespace) -> None:
        self.namespace = namespace
        self._drivers: dict[str, LiveDriver] = {}
        self._next_look_ns = 0

    def get(self, name: str) -> LiveDriver | None:
        """The driver of this name, if it is here now."""
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
                if name not in self._drivers:
                    self._attach(name)
            self._drivers = dict(sorted(self._drivers.items()))
        return list(self._drivers.values())

    def poll(self, driver: LiveDriver) -> bool:
        """``driver.poll()``; one that cannot be read any more is dropped, until it can."""
        try:
            return driver.poll()
        except (ServiceNotFound, BadServiceFile):
            self._drop(driver.name)
            return False

    def close(self) -> None:
        """Detach from all drivers. Idempotent."""
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
