"""Live touch for a loop of another program: the same sensors at each turn, or an error, or a flag."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, ServiceTimeout
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.skin import Skin
from skinware.skin_layout import SkinLayout
from skinware.snapshot import Snapshot
from skinware.status import age_limit_ns
from skinware.tactile.contacts_service import ContactsReader, ContactsSample
from skinware.tactile.regions import Region, Regions, read_regions

Positions = npt.NDArray[np.int64]

_LONGEST_WAIT = 2
"""So many periods a sample that may be nearer is waited for; it comes within half a period of a driver in time."""


@dataclass(frozen=True)
class ChosenSensors:
    """A choice of the sensors of one type.

    Attributes:
        type_name: their type.
        modules: names of modules (``right hand, index tip``) or patches; empty: all.
        regions: a file of regions; ``modules`` then are names in it.
    """

    type_name: str = "pressure"
    modules: Collection[str] = ()
    regions: str | Path | None = None

    def of(self, layout: SkinLayout) -> Positions:
        """Return (n,) int64: positions of the chosen sensors among those of the type, ascending.

        Raises:
            StructureError: no driver has such sensors.
            ConfigurationError: a name selects none of them; or a bad file.
        """
        count = len(layout.module_of(self.type_name))
        if not self.modules:
            return np.arange(count)
        if self.regions is None:
            known = Regions([Region(name, module=(name,), patch=(name,)) for name in dict.fromkeys(self.modules)])
        else:
            known = read_regions(self.regions)
        index, chosen = known.of(layout, self.type_name), np.zeros(count, bool)
        for name in self.modules:
            chosen[index[name]] = True
            if not chosen[index[name]].any():
                there_are = sorted({layout.modules[module] for module in layout.module_of(self.type_name).tolist()})
                raise ConfigurationError(f"no {self.type_name} sensors in {name!r}; modules: {'; '.join(there_are)}")
        return np.flatnonzero(chosen)


class TouchSample(NamedTuple):
    """Values of chosen sensors at a moment.

    Attributes:
        snapshot: of the skin; the last good one if ``is_held``.
        values: (n,) float32 in the unit of the type; 0 where ``fresh`` is false.
        fresh: (n,) bool, as of the moment.
        off_s: time of the data minus the moment, s: the driver furthest away.
        is_held: nothing young enough came, and this is the last touch before.
        contacts: the newest ones, of :class:`LiveTouch` with contacts; None: it has none.
    """

    snapshot: Snapshot
    values: npt.NDArray[np.floating[Any]]
    fresh: npt.NDArray[np.bool_]
    off_s: float
    is_held: bool
    contacts: ContactsSample | None = None


class LiveTouch:
    """The same sensors of the same drivers at each call, for loops that want arrays of one shape.

    It waits for a driver that comes back with the same sensors. Use it in one thread at a time.

    Args:
        sensors: which sensors.
        drivers: names of drivers; default: all that run when it is opened.
        namespace: default: the one of ``SKINWARE_NAMESPACE``.
        max_age_s: oldest data of each driver; default: three periods of the driver, at least 0.2 s.
        when_stale: ``raise`` a ServiceTimeout when a driver died, is silent or changed; or ``hold`` the last touch.
        contacts_in: namespace of the service ``contacts``, whose newest sample comes with the touch; None: without.

    Attributes:
        layout: of the skin when it was opened.
        positions: (n,) int64, positions of the sensors among those of their type.
    """

    def __init__(
        self,
        sensors: ChosenSensors | None = None,
        *,
        drivers: Collection[str] | None = None,
        namespace: Namespace | str | None = None,
        max_age_s: float | None = None,
        when_stale: Literal["raise", "hold"] = "raise",
        contacts_in: Namespace | str | None = None,
    ) -> None:
        self.sensors = ChosenSensors() if sensors is None else sensors
        self._contacts_in = contacts_in
        self._contacts: ContactsReader | None = None
        self._namespace, self._drivers = namespace, drivers
        self._max_age_s, self._when_stale = max_age_s, when_stale
        self._skin: Skin | None = None
        self._last: TouchSample | None = None
        self.layout: SkinLayout = SkinLayout((), ())
        self.positions: Positions = np.zeros(0, np.int64)

    @property
    def is_open(self) -> bool:
        """Whether it was opened, and not closed since."""
        return self._skin is not None

    def open(self, *, timeout_s: float = 5.0) -> Self:
        """Attach to the drivers, and wait for a sample of each.

        Raises:
            ServiceTimeout, ServiceNotFound: they did not all publish in time, or no contacts.
            StructureError, ConfigurationError: as :meth:`ChosenSensors.of`.
        """
        wanted = self._drivers
        if wanted is None:  # those that run now; others that begin later are not its business
            with Skin(self._namespace, types=[self.sensors.type_name]) as skin:
                wanted = skin.read(timeout_s=timeout_s).layout.drivers
        skin = Skin(self._namespace, drivers=wanted)
        try:
            deadline_ns = now_ns() + round(timeout_s * NS_PER_S)
            snapshot = skin.read(timeout_s=timeout_s)
            while missing := set(wanted) - set(snapshot.layout.drivers):
                left_s = (deadline_ns - now_ns()) / NS_PER_S
                if left_s <= 0:
                    raise ServiceTimeout(f"no driver {', '.join(sorted(missing))} in {skin.namespace.name!r}")
                with contextlib.suppress(ServiceTimeout):
                    snapshot = skin.read(newer_than=snapshot, timeout_s=min(left_s, 0.2))
            self.layout = snapshot.layout
            snapshot.unit(self.sensors.type_name)
            self.positions = self.sensors.of(self.layout)
            if self._contacts_in is not None:
                self._contacts = ContactsReader(namespace=self._contacts_in, timeout_s=timeout_s)
        except BaseException:
            skin.close()
            raise
        self._skin, self._last = skin, None
        return self

    def now(self) -> TouchSample:
        """Return the touch nearest to this moment: the newest one, unless it is more than half a period old.

        Then the next one is waited for, at most two periods of the driver.

        Raises:
            ServiceTimeout: a driver died, is silent, or came back with other sensors (``when_stale="raise"``).
            ConfigurationError: it is not open.
        """
        return self.at(now_ns())

    def at(self, time_ns: int) -> TouchSample:
        """Return the touch nearest to a moment; wait as :meth:`now`.

        Args:
            time_ns: the moment, CLOCK_MONOTONIC ns: now or a little earlier.
        """
        skin = self._opened()
        return self._taken(lambda: self._nearest(skin, time_ns), time_ns)

    def newer(self, *, timeout_s: float) -> TouchSample:
        """Return touch that is newer than the one returned before, as soon as a driver publishes it.

        Raises:
            ServiceTimeout: nothing newer came in time; or as :meth:`now`.
            ConfigurationError: it is not open.
        """
        skin, last = self._opened(), self._last
        with contextlib.suppress(ServiceTimeout):
            skin.read(newer_than=last and last.snapshot, timeout_s=timeout_s)
        touch = self._taken(lambda: skin.read(timeout_s=0.0), now_ns())
        if last and not touch.is_held and (touch.snapshot.acquired_ns <= last.snapshot.acquired_ns).all():
            raise ServiceTimeout(f"no newer touch within {timeout_s:g} s")
        return touch

    def close(self) -> None:
        """Detach from all drivers. Idempotent."""
        if self._skin is not None:
            self._skin.close()
        if self._contacts is not None:
            self._contacts.close()
        self._skin = self._contacts = None

    def _opened(self) -> Skin:
        if self._skin is None:
            raise ConfigurationError("touch is read before it was opened")
        return self._skin

    def _taken(self, take: Callable[[], Snapshot], time_ns: int) -> TouchSample:
        """Return the touch in a snapshot, or hold the last one."""
        try:
            snapshot = take()
            self._check(snapshot)
            self._last = self._sample(snapshot, time_ns)
        except ServiceTimeout:
            if self._when_stale == "raise" or self._last is None:
                raise
            return self._last._replace(is_held=True)
        return self._last

    def _nearest(self, skin: Skin, time_ns: int) -> Snapshot:
        snapshot = skin.read(timeout_s=0.0)
        self._check(snapshot)
        longest_ns = _LONGEST_WAIT * max(sample.period_ns for sample in snapshot.samples)
        while (left_ns := time_ns + longest_ns - now_ns()) > 0 and self._may_be_nearer(snapshot, time_ns):
            with contextlib.suppress(ServiceTimeout):
                snapshot = skin.read(newer_than=snapshot, timeout_s=left_ns / NS_PER_S)
        return skin.at(time_ns).nearest

    def _sample(self, snapshot: Snapshot, time_ns: int) -> TouchSample:
        contacts = None if self._contacts is None else self._contacts.latest()
        ages = [
            (name, time_ns - sample.acquired_ns, sample.period_ns)
            for name, sample in zip(snapshot.layout.drivers, snapshot.samples, strict=True)
        ]
        if self._contacts is not None:
            longest_ns = max(period_ns for _, _, period_ns in ages)
            ages.append(("contacts", time_ns - (contacts.acquired_ns if contacts else 0), longest_ns))
        too_old = [
            f"{name} ({age_ns / NS_PER_S:.2f} s)"
            for name, age_ns, period_ns in ages
            if age_ns > self._limit_ns(period_ns)
        ]
        if too_old:
            raise ServiceTimeout(f"drivers whose data is too old: {', '.join(too_old)}")
        type_name = self.sensors.type_name
        fresh = snapshot.fresh(type_name, max_age_s=self._max_age_s, at_ns=time_ns)[self.positions]
        values = np.where(fresh, snapshot.physical(type_name)[self.positions], 0)
        off_ns = snapshot.acquired_ns - time_ns
        off_s = float(off_ns[np.argmax(np.abs(off_ns))]) / NS_PER_S
        return TouchSample(snapshot, values, fresh, off_s, False, contacts)

    def _may_be_nearer(self, snapshot: Snapshot, time_ns: int) -> bool:
        """Return whether a sample to come can be nearer to the moment than the newest one."""
        return any(
            sample.period_ns / 2 < time_ns - sample.acquired_ns <= self._limit_ns(sample.period_ns)
            for sample in snapshot.samples
        )

    def _limit_ns(self, period_ns: int) -> int:
        return age_limit_ns(period_ns) if self._max_age_s is None else round(self._max_age_s * NS_PER_S)

    def _check(self, snapshot: Snapshot) -> None:
        if snapshot.layout is self.layout:
            return
        gone = set(self.layout.drivers) - set(snapshot.layout.drivers)
        if gone:
            raise ServiceTimeout(f"drivers that died or were stopped: {', '.join(sorted(gone))}")
        pairs = zip(self.layout.drivers, self.layout.structures, strict=True)
        if any(snapshot.of(name).structure != structure for name, structure in pairs):
            raise ServiceTimeout("a driver came back with other sensors: open again")
        self.layout = snapshot.layout

    def __enter__(self) -> Self:
        return self if self.is_open else self.open()

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(kw_only=True)
class TouchOptions:
    """Options of live touch for configurations of other programs, where an empty text means the default.

    Attributes:
        driver: name of a driver; empty: all that run when it is opened.
        namespace: of the driver; empty: the one of ``SKINWARE_NAMESPACE``.
        type_name: type of the sensors.
        modules: names of modules or patches, or of regions if there is a file of them; empty: all sensors.
        regions: a file of regions.
        max_age_ms: oldest data; default: three periods of the driver, at least 200 ms.
        when_stale: ``raise`` an error when a driver died or is silent, or ``hold`` the last touch.
        contacts_namespace: of the service ``contacts``, where contacts are asked for.
        timeout_s: longest wait for the drivers.
    """

    driver: str = ""
    namespace: str = ""
    type_name: str = "pressure"
    modules: list[str] = field(default_factory=list)
    regions: str = ""
    max_age_ms: float | None = None
    when_stale: str = "raise"
    contacts_namespace: str = "calm"
    timeout_s: float = 5.0

    def check(self, **known: tuple[str, ...]) -> None:
        """Check options that are one of some words: ``when_stale``, and those of a class derived from this one.

        Raises:
            ValueError: an option is none of its words; the message lists them.
        """
        for name, words in {"when_stale": ("raise", "hold"), **known}.items():
            if getattr(self, name) not in words:
                raise ValueError(f"{name} is {getattr(self, name)!r}: give one of {', '.join(words)}")

    def touch(self, *, with_contacts: bool = False) -> LiveTouch:
        """Return the touch of these options, to be opened."""
        return LiveTouch(
            ChosenSensors(self.type_name, tuple(self.modules), self.regions or None),
            drivers=[self.driver] if self.driver else None,
            namespace=self.namespace or None,
            max_age_s=None if self.max_age_ms is None else self.max_age_ms / 1000,
            when_stale="hold" if self.when_stale == "hold" else "raise",
            contacts_in=self.contacts_namespace if with_contacts else None,
        )
