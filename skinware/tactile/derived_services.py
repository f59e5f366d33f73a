"""Publish contacts, motion and health beside a calmed driver.

They share one pattern: each follows the chain of the driver from structure to structure, publishes what it computes
from every sample, and gives itself up on an error, as calm values are worth more than any of them.
"""

from __future__ import annotations

import ctypes
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.errors import ConfigurationError, NameInUse
from skinware.memory.namespace import Namespace
from skinware.native import give_arrays
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.tactile.arrays import Arrays, Bytes, Flags, Floats
from skinware.tactile.baseline import SIGNED_TYPES
from skinware.tactile.chain import Chain
from skinware.tactile.contacts import ContactSet
from skinware.tactile.contacts_service import ContactsWriter, More
from skinware.tactile.health_service import RATE_HZ, ChainHealth, HealthWriter
from skinware.tactile.motion import MotionWriter
from skinware.tactile.regions import Regions
from skinware.tactile.source_service import ServiceOptions, SourceWriter
from skinware.tactile.stages import STRUCTS

log: logging.Logger = logging.getLogger("skinware.calm")

WriterT = TypeVar("WriterT", bound=SourceWriter)

_find_loads = native.core().quick.skinware_chain_loads
_find_loads.argtypes, _find_loads.restype = (ctypes.c_void_p,) * 2, None

_HEALTH_PERIOD_NS = round(NS_PER_S / RATE_HZ)


class DerivedService(ABC, Generic[WriterT]):
    """A service beside a calmed driver, computed from its samples.

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
    """The loads of n taxels of a chain: values of one type, or lengths of vectors of three; computed in C.

    Contacts are those of the last type, ``type_name``. All arrays are of the newest sample, and the next one overwrites
    them.

    Attributes:
        load: (n,) float32, the loads.
        touched: (n,) bool, which taxels are touched, of those with values of this sample.
        more: onsets, clipped taxels, uncertainties (in the unit ``unit``; else None), and loads over noise.
    """

    def __init__(self, chain: Chain, names: tuple[str, ...]) -> None:
        self.type_name = names[-1]
        stages, n = [chain.baseline_stages[name] for name in names], len(chain.uid(names[0]))
        before = stages[-1].before
        axes, self._words = (STRUCTS["Axis"] * len(names))(), STRUCTS["Loads"]()
        self._kept: list[Any] = [chain, axes]
        for axis, name, stage in zip(axes, names, stages, strict=True):
            shown = {
                key: getattr(stage.shown, key) for key in ("baseline", "uncertainty", "noise", "touched", "usable")
            }
            given: Arrays = {"index": chain.structure.index(name), "given": stage.given}
            self._kept.append(give_arrays(axis, n, {}, given | shown))
        self._words.n, self._words.n_axes, self._words.axes = n, len(names), ctypes.addressof(axes)
        self._words.resolution, self._words.maximum = before.resolution, before.type.maximum
        arrays = give_arrays(self._words, n, {})
        self.load: Floats = arrays["load"]
        self.touched: Flags = arrays["touched"]
        is_in_unit = chain.structure.type(self.type_name).unit == before.type.unit
        self.more: More = {
            "onset": arrays["onset"],
            "clipped": arrays["clipped"],
            "uncertainty": arrays["doubt"] if is_in_unit else None,
            "sigmas": arrays["sigmas"],
        }
        self._kept.append(arrays)
        self._at = chain.at, ctypes.addressof(self._words)

    @classmethod
    def of(cls, chain: Chain) -> Self | None:
        """Return those of pressures, else of another type that a touch only raises, else of vectors; None: of none."""
        rising = [name for name in chain.baseline_stages if not name.startswith(SIGNED_TYPES)]
        if rising:
            return cls(chain, ("pressure" if "pressure" in rising else rising[0],))
        vectors = [names for names in chain.vectors if set(names) <= set(chain.baseline_stages)]
        return cls(chain, vectors[0]) if vectors else None

    def find(self) -> None:
        """Find the loads in what the chain made of the newest sample."""
        _find_loads(*self._at)


class CalmContacts(DerivedService[ContactsWriter]):
    """The contacts of one calmed driver.

    They are found in pressures, or else in another type that a touch only raises, or else in the lengths of vectors.
    Poses of coordinate frames on the robot, (4, 4) by name, let contacts hang together across their borders. ``newest``
    are those of the newest sample, and the (n,) loads in which they were found; None: there are none.
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
        self._poses = poses
        self._loads: Loads | None = None

    def _follow(self, chain: Chain, rate_hz: float | None) -> None:
        self._loads, self.newest = Loads.of(chain), None
        if self._loads is None:
            self.close()
            return
        structure, type_name = chain.structure, self._loads.type_name
        if self.writer is not None and self.writer.source.type_name == type_name:
            self.writer.go_on(structure)
        else:
            self.close()
            more = {"driver": self._driver, "poses": self._poses, "rate_hz": rate_hz}
            self._open(ContactsWriter, structure, type_name, **more)

    def publish(self, acquired_ns: int) -> None:
        """Find the contacts in the output of the chain, and publish them."""
        if self.writer is None or self._loads is None:
            return
        loads = self._loads
        loads.find()
        with self._or_none():
            self.newest = self.writer.publish(loads.load, loads.touched, acquired_ns, **loads.more), loads.load

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
        """Take in what the chain made of a sample, and judge the sensors when it is time."""
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
