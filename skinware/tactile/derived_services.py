"""Publish contacts, motion and health beside a calmed driver.

They share one pattern: each follows the chain of the driver from structure to structure, publishes what it computes
from every frame, and gives itself up on an error, as calm values are worth more than any of them.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, NameInUse
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.tactile.arrays import Bytes, Flags, Floats
from skinware.tactile.baseline import SIGNED_TYPES, UNUSABLE
from skinware.tactile.chain import Chain
from skinware.tactile.contacts import ContactSet
from skinware.tactile.contacts_service import ContactsWriter, More
from skinware.tactile.health_service import RATE_HZ, ChainHealth, HealthWriter
from skinware.tactile.motion import MotionWriter
from skinware.tactile.neighbours import neighbours, posed
from skinware.tactile.onsets import Onsets
from skinware.tactile.regions import Regions
from skinware.tactile.source_service import ServiceOptions, SourceWriter

log: logging.Logger = logging.getLogger("skinware.calm")

WriterT = TypeVar("WriterT", bound=SourceWriter)

_HEALTH_PERIOD_NS = round(NS_PER_S / RATE_HZ)


class DerivedService(ABC, Generic[WriterT]):
    """A service beside a calmed driver, computed from its frames.

    If another program has a service of this name, the name of the driver and a hyphen come before it. Without a name
    there is none.
    """

    kind: ClassVar[str]

    def __init__(self, name: str | None, driver: str, into: Namespace, group: str | None = None) -> None:
        self._name, self._driver = name, driver
        self._options: ServiceOptions = {"namespace": into, "group": group}
        self.writer: WriterT | None = None

    @property
    def name(self) -> str:
        """Name of the service; empty while there is none."""
        return "" if self.writer is None else self.writer.name

    def follow(self, chain: Chain, rate_hz: float | None = None) -> None:
        """Go on with another chain, of other sensors, at the nominal rate of the driver."""
        if self._name:
            with self._or_none():
                self._follow(chain, rate_hz)

    @abstractmethod
    def _follow(self, chain: Chain, rate_hz: float | None) -> None: ...

    def close(self) -> None:
        """Withdraw the service. Idempotent."""
        if self.writer is not None:
            self.writer.close()
        self.writer = None

    def _open(self, make: Callable[..., WriterT], *given: Any, **options: Any) -> None:
        """Make the writer, under the first name that is free; raises NameInUse if none is."""
        try:
            self.writer = make(*given, name=self._name, **options, **self._options)
        except NameInUse:
            self.writer = make(*given, name=f"{self._driver}-{self._name}", **options, **self._options)

    @contextmanager
    def _or_none(self) -> Iterator[None]:
        """Withdraw the service if places have no neighbours, or another program takes its name."""
        try:
            yield
        except (ConfigurationError, NameInUse) as error:
            self.close()
            log.warning("no %s of %r: %s", self.kind, self._driver, str(error))


class Loads:
    """The loads of n taxels of a chain: values of one type, or lengths of vectors of three.

    Contacts are those of the last type, ``type_name``.
    """

    def __init__(self, chain: Chain, names: tuple[str, ...]) -> None:
        self.type_name, self.n_sensors = names[-1], chain.structure.n_sensors
        self._stages = [chain.baseline_stages[name] for name in names]
        self._indexes = [chain.structure.index(name) for name in names]
        self._before = self._stages[-1].before
        self._onsets = Onsets(len(self._before), self._before.resolution)

    @classmethod
    def of(cls, chain: Chain) -> Self | None:
        """Return those of pressures, else of another type that a touch only raises, else of vectors; None: of none."""
        rising = [name for name in chain.baseline_stages if not name.startswith(SIGNED_TYPES)]
        if rising:
            return cls(chain, ("pressure" if "pressure" in rising else rising[0],))
        vectors = [names for names in chain.vectors if set(names) <= set(chain.baseline_stages)]
        return cls(chain, vectors[0]) if vectors else None

    def usable(self, status: Bytes) -> Flags:
        """Return (n,) bool, which taxels have values of this frame, of (n_sensors,) status."""
        usable: Flags = np.logical_and.reduce([(status[index] & UNUSABLE) == 0 for index in self._indexes])
        return usable

    def values(self, values: Floats) -> Floats:
        """Return (n,) loads of (n_sensors,) values."""
        return _length([values[index] for index in self._indexes])

    @property
    def touched(self) -> Flags:
        """(n,) bool, which taxels are touched in the newest frame."""
        touched: Flags = np.logical_or.reduce([stage.touched for stage in self._stages])
        return touched

    def more(self, usable: Flags, unit: str) -> More:
        """Return onsets, clipped taxels, (in the same unit) uncertainties and loads over noise, as far as known."""
        calms = [(stage.given, stage.calm) for stage in self._stages if stage.calm is not None]
        if not calms:
            return {}
        deviation = _length([given - calm.baseline for given, calm in calms])
        doubt = _length([np.hypot(calm.noise, calm.uncertainty) for _, calm in calms]) / np.sqrt(np.float32(len(calms)))
        known = np.logical_and.reduce([usable, *(calm.usable for _, calm in calms)])
        clipped = np.logical_or.reduce([given >= self._before.type.maximum for given, _ in calms])
        given, calm = calms[-1]  # of a vector, the axis along the normal: shear moves its length before it slips
        return {
            "onset": self._onsets.update(deviation, doubt, known),
            "clipped": clipped,
            "uncertainty": doubt if unit == self._before.type.unit else None,
            "sigmas": (given - calm.baseline) / np.where(known & (calm.noise > 0), calm.noise, np.float32(np.nan)),
        }


def _length(axes: list[Floats]) -> Floats:
    """Return (n,) lengths of vectors, by their axes (n,) each; one axis is its own length, with its sign."""
    length: Floats = axes[0] if len(axes) == 1 else np.sqrt(sum(axis**2 for axis in axes))
    return length


class CalmContacts(DerivedService[ContactsWriter]):
    """The contacts of one calmed driver.

    They are found in pressures, or else in another type that a touch only raises, or else in the lengths of vectors.
    Poses of coordinate frames on the robot, (4, 4) by name, let contacts hang together across their borders. ``newest``
    are those of the newest frame, and the (n,) loads in which they were found; None: there are none.
    """

    kind = "contacts"

    def __init__(
        self,
        name: str | None,
        driver: str,
        into: Namespace,
        group: str | None = None,
        poses: Mapping[str, npt.ArrayLike] | None = None,
    ) -> None:
        super().__init__(name, driver, into, group)
        self.newest: tuple[ContactSet, Floats] | None = None
        self._poses = poses or {}
        self._loads: Loads | None = None

    def _follow(self, chain: Chain, rate_hz: float | None) -> None:
        self._loads, self.newest = Loads.of(chain), None
        if self._loads is None:
            self.close()
            return
        structure, type_name, beside = chain.structure, self._loads.type_name, None
        if structure.geometry is not None and self._poses:
            beside = neighbours(posed(structure.geometry[structure.index(type_name)], self._poses))
        if self.writer is not None and self.writer.source.type_name == type_name:
            self.writer.go_on(structure, neighbours=beside)
        else:
            self.close()
            more = {"driver": self._driver, "neighbours": beside, "rate_hz": rate_hz}
            self._open(ContactsWriter, structure, type_name, **more)

    def publish(self, values: Floats, status: Bytes, acquired_ns: int) -> None:
        """Find the contacts in the (n_sensors,) output of the chain, and publish them."""
        if self.writer is None or self._loads is None:
            return
        usable, loads = self._loads.usable(status), self._loads.values(values)
        more = self._loads.more(usable, self.writer.source.unit)
        with self._or_none():
            self.newest = self.writer.publish(loads, self._loads.touched & usable, acquired_ns, **more), loads

    def publish_none(self, time_ns: int) -> None:
        """Publish that nothing is touched, as the driver is dead."""
        if self._loads is not None:
            n = self._loads.n_sensors
            self.publish(np.zeros(n, np.float32), np.full(n, np.uint8(UNUSABLE)), time_ns)

    def close(self) -> None:
        super().close()
        self.newest = None


class CalmMotion(DerivedService[MotionWriter]):
    """The motion of regions of one calmed driver, by its contacts."""

    kind = "motion"

    def __init__(
        self,
        name: str | None,
        driver: str,
        into: Namespace,
        group: str | None,
        regions: Regions,
        contacts: CalmContacts,
    ) -> None:
        super().__init__(name, driver, into, group)
        self._regions, self._contacts = regions, contacts

    def _follow(self, chain: Chain, rate_hz: float | None) -> None:
        self.close()
        if self._contacts.writer is not None:
            source = self._contacts.writer.source
            given = chain.structure, source.type_name, self._regions, source.frames
            self._open(MotionWriter, *given, driver=self._driver, rate_hz=rate_hz)

    def publish(self, acquired_ns: int) -> None:
        """Publish the motion of the newest contacts."""
        if self.writer is not None and self._contacts.newest is not None:
            with self._or_none():
                self.writer.publish(*self._contacts.newest, acquired_ns)


class CalmHealth(DerivedService[HealthWriter]):
    """The health of one calmed driver, for all types that have a baseline and that a touch only raises.

    Attributes:
        judged: the health; None before the driver was seen.
        faulty: number of sensors with a fault.
    """

    kind = "health"

    def __init__(self, name: str | None, driver: str, into: Namespace, group: str | None = None) -> None:
        super().__init__(name, driver, into, group)
        self.faulty = 0
        self.judged: ChainHealth | None = None
        self._status: Bytes = np.zeros(0, np.uint8)
        self._due_ns = 0

    def _follow(self, chain: Chain, rate_hz: float | None) -> None:  # noqa: ARG002 - it has a rate of its own
        self.judged, self.faulty = ChainHealth(chain, self._driver), 0
        self._status = np.zeros(chain.structure.n_sensors, np.uint8)
        if not self.judged:
            self.close()
        elif self.writer is not None:
            self.writer.go_on(chain.structure)
        else:
            self._open(HealthWriter, chain.structure, self._driver)

    def mark(self, status: Bytes) -> None:
        """Mark sensors with a fault in (n_sensors,) status."""
        if self.judged is not None:
            status |= self._status

    def update(self, acquired_ns: int) -> None:
        """Take in what the chain made of a frame, and judge the sensors when it is time."""
        if self.judged is None:
            return
        self.judged.update(acquired_ns)
        if acquired_ns >= self._due_ns:
            self._due_ns = acquired_ns + _HEALTH_PERIOD_NS
            reports = self.judged.reports()
            self._status = np.uint8(Status.UNHEALTHY) * self.judged.faulty(reports)
            self.faulty = int(np.count_nonzero(self._status))
            if self.writer is not None:
                with self._or_none():
                    self.writer.publish(reports, acquired_ns)
