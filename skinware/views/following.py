"""Follow drivers once for all viewers: newest snapshots, their states, and what services publish about them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, SupportsFloat

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import NamespaceError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.state import LIVE, PAUSED, STARTING, DriverReport, life_of, report_of, status_now
from skinware.status import Status
from skinware.tactile.contacts_service import ContactsReader, ContactsSample
from skinware.tactile.motion import MotionReader, MotionSample
from skinware.tactile.source_service import SourceReader
from skinware.views.history import DriverRest, RecentValues
from skinware.views.live import LiveDriver, LiveDrivers, LiveSources
from skinware.views.quantities import Newest, Quantity, quantities_of
from skinware.views.robot import Robot
from skinware.views.scene import Scene

_JUDGE_EVERY_NS = NS_PER_S // 5
_LOOK_EVERY_NS = NS_PER_S
"""Between two looks for services of all kinds, one after the other: what came first warms the caches for the others."""
_CALM_WITHIN_NS = 20_000_000
"""A calmed snapshot follows the snapshot that it was made of within this time, or not at all."""
_EARLY_NS = 5_000_000
"""A snapshot may be taken this much earlier than the pace asks for."""


class Origin:
    """A namespace whose drivers are followed, with the services about them: calmed drivers, contacts and motion.

    Contacts and motion may be in the namespace of calmed drivers, too.

    Args:
        calm: namespace of calmed drivers; None: without it.
        recording: title of the recording that is published there; None: its drivers are live.
        is_beside: others are shown too, so that the names of its drivers need its title.
    """

    def __init__(
        self,
        namespace: Namespace,
        names: Collection[str] = (),
        calm: Namespace | None = None,
        recording: str | None = None,
        *,
        is_beside: bool = False,
    ) -> None:
        self.namespace, self.names, self.calm = namespace, tuple(names), calm
        self.recording, self.is_beside = recording, is_beside
        self.live = LiveDrivers(namespace, names, every_ns=_LOOK_EVERY_NS)
        self._calm = None if calm is None else LiveDrivers(calm, names)
        namespaces = [namespace, *([] if calm is None else [calm])]
        self._contacts = [LiveSources[ContactsSample](each, ContactsReader) for each in namespaces]
        self._motion = [LiveSources[MotionSample](each, MotionReader) for each in namespaces]
        self._services: list[LiveSources[Any] | LiveDrivers] = [*self._contacts, *self._motion]
        self._services += [] if self._calm is None else [self._calm]
        self._look_ns = 0

    @property
    def title(self) -> str:
        """The part of its drivers' keys that is the same whenever they are shown."""
        return self.recording or self.namespace.name

    def look(self) -> list[LiveDriver]:
        if now_ns() >= self._look_ns:
            self._look_ns = now_ns() + _LOOK_EVERY_NS
            for services in self._services:
                services.look()
        return self.live.look()

    def calmed(self, driver: str) -> LiveDriver | None:
        return None if self._calm is None else self._calm.get(driver)

    def is_due(self, live: LiveDriver) -> bool:
        """Return whether the newest snapshot of a driver may be shown: its calmed one is here, or will not follow."""
        frame, calm = live.frame, self.calmed(live.name)
        if frame is None or calm is None or self._calm is None:
            return frame is not None
        self._calm.poll(calm)
        is_here = calm.frame is not None and calm.frame.acquired_ns >= frame.acquired_ns
        return is_here or now_ns() - frame.published_ns > _CALM_WITHIN_NS

    def about(self, driver: str) -> tuple[DriverSnapshot | None, ContactsSample | None, MotionSample | None]:
        """Return the newest snapshot of a calmed driver, contacts and motion; None where no living service has one."""
        live = self.calmed(driver)
        calm = None if live is None or live.frame is None or live.frame.stale else live.frame
        contacts = next((sample for source in self._contacts if (sample := source.of(driver)) is not None), None)
        motion = next((found for source in self._motion if (found := source.of(driver)) is not None), None)
        return calm, contacts, motion

    def contacts_reader(self, driver: str) -> SourceReader[ContactsSample] | None:
        found = (reader for source in self._contacts for reader in source.readers.values())
        return next((reader for reader in found if reader.source.driver == driver), None)

    def close(self) -> None:
        for services in self._services:
            services.close()
        self.live.close()


@dataclass
class PlotFunction:
    """A function of snapshots of a driver (None: the first) that is plotted; ``problem``: why it failed last."""

    function: Callable[[DriverSnapshot], SupportsFloat]
    driver: str | None = None
    unit: str = ""
    problem: str = ""

    def __call__(self, frame: DriverSnapshot) -> float:
        try:
            value, self.problem = float(self.function(frame)), ""
        except Exception as error:  # noqa: BLE001 - a user's function may raise anything
            value, self.problem = float("nan"), f"{type(error).__name__}: {error}"
        return value


class ShownDriver:
    """A driver as all viewers see it.

    Args:
        number: by which viewers know it, also after a restart.

    Attributes:
        generation: in which the driver began with this structure.
        changes: grows with each snapshot and each change of the status.
        since_ns: when each of its problems was first seen, by what it is; see :func:`skinware.views.tree.problems_of`.
    """

    def __init__(self, number: int, live: LiveDriver, origin: Origin) -> None:
        self.number, self.live, self.origin = number, live, origin
        self.life = STARTING
        self.changes = 0
        self.since_ns: dict[tuple[object, ...], int] = {}
        self.taken_ns = self._judged_ns = 0
        self.newest: Newest | None = None
        self.structure, self.generation = live.structure, live.reader.generation
        self.quantities = quantities_of(self.structure)
        self.past, self.rest = RecentValues(self.structure), DriverRest(self.structure)

    @property
    def name(self) -> str:
        """Its name for people, which no other driver has that is shown."""
        return f"{self.live.name} ({self.origin.title})" if self.origin.is_beside else self.live.name

    @property
    def frame(self) -> DriverSnapshot | None:
        return None if self.newest is None else self.newest.frame

    @property
    def status(self) -> npt.NDArray[np.uint8]:
        if self.newest is None:
            return np.full(self.structure.n_sensors, int(Status.NEVER_SEEN), np.uint8)
        return self.newest.status

    def quantity(self, name: str) -> Quantity | None:
        return next((quantity for quantity in self.quantities if quantity.name == name), None)

    def report(self) -> DriverReport:
        live = self.live
        report = report_of(
            live.reader, self.frame, live.rate_hz, live.patch_rates_hz, life=self.life, status=self.status
        )
        if self._stands_still:
            patches = tuple(replace(patch, rate_hz=None, age_ns=None) for patch in report.patches)
            report = replace(report, rate_hz=None, age_ns=None, patches=patches)
        return report

    @property
    def _stands_still(self) -> bool:
        return self.origin.recording is not None and life_of(self.live.reader, self.frame) == PAUSED

    def take(self, frame: DriverSnapshot) -> None:
        if frame.structure is not self.structure and frame.structure != self.structure:
            self.structure, self.generation = frame.structure, frame.generation
            self.quantities = quantities_of(self.structure)
            self.past, self.rest = RecentValues(self.structure), DriverRest(self.structure)
        self.taken_ns, self.life = now_ns(), LIVE
        self.past.add(frame.values, frame.published_ns)
        at_ns = None if self.origin.recording is None else frame.published_ns  # it may have been paused meanwhile
        self.newest = self._judged(frame, status_now(LIVE, frame, at_ns), is_newer=True)
        if self.rest.is_due(frame.published_ns):
            self.rest.follow(self.newest.all_physical(), self.newest.status == 0, frame.published_ns)
        self.changes += 1

    def judge(self) -> None:
        """Judge again a driver that has published nothing newer. While a recording is paused, time stands still."""
        before = self.newest
        if before is None or now_ns() - self._judged_ns < _JUDGE_EVERY_NS:
            return
        before_life, life = self.life, life_of(self.live.reader, before.frame)
        stands_still = self._stands_still
        self.life = before_life if stands_still else life
        self.newest = self._judged(before.frame, before.status if stands_still else status_now(life, before.frame))
        if (
            self.life != before_life
            or not np.array_equal(self.newest.status, before.status)
            or self.newest.contacts_position != before.contacts_position
        ):
            self.changes += 1

    def _judged(self, frame: DriverSnapshot, status: npt.NDArray[np.uint8], *, is_newer: bool = False) -> Newest:
        self._judged_ns = now_ns()
        calm, contacts, motion = self.origin.about(self.live.name)
        if calm is not None and not (
            np.array_equal(calm.structure.sensor_uid, self.structure.sensor_uid)
            and np.array_equal(calm.structure.sensor_type, self.structure.sensor_type)
        ):
            calm = None  # it has other sensors
        if calm is not None:
            status = status | (calm.status & np.uint8(Status.UNHEALTHY))
        live, last = self.origin.calmed(self.live.name) if calm is not None else self.live, calm or frame
        before = (self.newest.calm or self.newest.frame).position if self.newest is not None else None
        read_all = partial(live.until, last, before) if is_newer and live is not None else lambda: [last]
        return Newest(frame, status, calm, contacts, motion, read_all)


class Follower:
    """All drivers of some namespaces, and what services publish about them.

    Attributes:
        edition: changes whenever drivers or structures change.
        functions: of snapshots that viewers plot, by the names of their lines.
    """

    def __init__(self, *origins: Origin, robot: Robot | None = None) -> None:
        self.origins = origins
        self.drivers: list[ShownDriver] = []
        self.problem: str | None = None
        self.edition = 0
        self.functions: dict[str, PlotFunction] = {}
        self.robot = robot or Robot()
        self.scene = Scene({}, self.robot.poses)
        self._numbers: dict[tuple[str, str], int] = {}
        self._found: list[list[LiveDriver]] = [[] for _ in origins]

    def get(self, number: int) -> ShownDriver | None:
        return next((driver for driver in self.drivers if driver.number == number), None)

    @property
    def slack_s(self) -> float:
        """How long the ring of the fastest driver keeps a snapshot."""
        slacks_ns = [driver.live.reader.slack_ns for driver in self.drivers]
        return min([slack_ns for slack_ns in slacks_ns if slack_ns], default=NS_PER_S) / NS_PER_S

    def take(self, period_ns: int) -> list[ShownDriver]:
        """Take newer snapshots without waiting.

        Returns:
            The drivers with a newer snapshot; their ``changes``, and ``edition``, show what else has changed.
        """
        self.problem = None
        try:
            found = [origin.look() for origin in self.origins]
        except NamespaceError as error:
            self.problem = str(error)
            return []
        if self._found != found:
            self._found = found
            kept = {id(driver.live): driver for driver in self.drivers}
            self.drivers = []
            for origin, lives in zip(self.origins, found, strict=True):
                for live in lives:
                    number = self._numbers.setdefault((origin.title, live.name), len(self._numbers))
                    self.drivers.append(kept.get(id(live)) or ShownDriver(number, live, origin))
            self._arrange()
        generations = [driver.generation for driver in self.drivers]
        newer = [driver for driver in self.drivers if self._take(driver, period_ns)]
        if generations != [driver.generation for driver in self.drivers]:
            self._arrange()
        return newer

    def close(self) -> None:
        for origin in self.origins:
            origin.close()
        self.drivers = []

    def _take(self, driver: ShownDriver, period_ns: int) -> bool:
        if now_ns() - driver.taken_ns < period_ns - _EARLY_NS:
            return False
        live, origin = driver.live, driver.origin
        if live.frame is driver.frame:
            origin.live.poll(live)
        if live.frame is None or live.frame is driver.frame:
            driver.judge()
        elif origin.is_due(live):
            driver.take(live.frame)
            return True
        return False

    def _arrange(self) -> None:
        self.edition += 1
        self.scene = Scene(
            {driver.name: (driver.structure, driver.quantities) for driver in self.drivers}, self.robot.poses
        )
