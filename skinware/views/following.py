"""Follow drivers once for all viewers: newest snapshots, their states, and what services publish about them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import NamespaceError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.state import LIVE, STARTING, DriverReport, life_of, report_of, settling, status_now
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.contacts_service import ContactsSample
from skinware.tactile.motion_service import MotionSample
from skinware.views.history import DriverRest, RecentValues
from skinware.views.live import LiveDriver, LiveDrivers, TactileServices
from skinware.views.quantities import WITHOUT_VALUE, Quantity, physical_values, quantities_of
from skinware.views.robot import Robot
from skinware.views.scene import Scene

_JUDGE_EVERY_NS = NS_PER_S // 5
_EARLY_NS = 5_000_000
"""A snapshot may be taken this much earlier than the pace asks for."""
_UNHEALTHY, _NEVER_SEEN, _ALL_BITS = np.uint8(Status.UNHEALTHY), np.uint8(Status.NEVER_SEEN), np.uint8(0xFF)


@dataclass(eq=False)
class Newest:
    """The newest snapshot of a driver, and what is known about it now.

    Attributes:
        status: (n_sensors,) uint8, status of its sensors now, with the health that the calmed driver publishes.
        calm: snapshot of the calmed driver, if it lives and has the same sensors.
        contacts, motion: on the driver; None where no service publishes them.
        shared: results that several viewers need, by a key of their own.
    """

    frame: DriverSnapshot
    status: npt.NDArray[np.uint8]
    calm: DriverSnapshot | None
    contacts: ContactsSample | None
    motion: MotionSample | None
    shared: dict[object, Any] = field(default_factory=dict)

    def once(self, key: object, make: Callable[[], Any]) -> Any:
        """Return a result that is made once for all viewers."""
        if key not in self.shared:
            self.shared[key] = make()
        return self.shared[key]

    def physical(self, quantity: Quantity) -> npt.NDArray[np.floating[Any]]:
        """Return (n,) values of a quantity's sensors in its unit."""
        values: npt.NDArray[np.floating[Any]] = self.once(
            ("physical", quantity.name), lambda: self.frame.physical(quantity.type.name)
        )
        return values

    def all_physical(self) -> npt.NDArray[np.float32]:
        """Return (n_sensors,) float32, values of the sensors of all types, each in its unit."""
        values: npt.NDArray[np.float32] = self.once("all", lambda: physical_values(self.frame))
        return values

    def above_baseline(self, quantity: Quantity) -> npt.NDArray[np.floating[Any]] | None:
        """Return (n,) how far values are above their baselines, 0 without touch; None without a calmed driver."""
        calm = self.calm
        if calm is None:
            return None
        values: npt.NDArray[np.floating[Any]] = self.once(
            ("calm", quantity.name), lambda: calm.physical(quantity.type.name)
        )
        return values

    @property
    def why(self) -> npt.NDArray[np.uint8]:
        """(n_sensors,) uint8: a :class:`skinware.status.Why` for each, of the calmed driver."""
        return (self.calm or self.frame).why

    @property
    def settling(self) -> npt.NDArray[np.bool_]:
        """(n_sensors,) bool: those whose baselines the calmed driver does not know yet."""
        waiting: npt.NDArray[np.bool_] = self.once("settling", lambda: settling(self.calm or self.frame))
        return waiting

    @property
    def marked(self) -> npt.NDArray[np.uint8]:
        """(n_sensors,) uint8: ``status``, but all bits for sensors that were seen, and wait for their baselines."""
        marked: npt.NDArray[np.uint8] = self.once(
            "marked", lambda: np.where(self.settling & ((self.status & _NEVER_SEEN) != 0), _ALL_BITS, self.status)
        )
        return marked

    def totals(self, quantity: Quantity) -> npt.NDArray[np.float64] | None:
        """Return (n_modules,) the load on each module, in the quantity's unit.

        None where values are no loads: they are counts, and no calmed driver has their baselines.
        """
        loads = self.above_baseline(quantity)
        if loads is None and not quantity.type.unit.endswith("N"):
            return None
        loads = self.physical(quantity) if loads is None else loads
        loads = np.where((self.status[quantity.where] & WITHOUT_VALUE) == 0, np.nan_to_num(loads), 0)
        structure = self.frame.structure
        module = structure.sensor_module[quantity.where]
        return np.bincount(module, loads, structure.n_modules).astype(np.float64)


class ShownDriver:
    """A driver as all viewers see it.

    Args:
        number: by which viewers know it, also after a restart.

    Attributes:
        generation: in which the driver began with this structure.
        life: what it is doing; see :func:`skinware.state.life_of`.
        newest: its newest snapshot; None before the first.
        status: (n_sensors,) uint8, status of its sensors now.
        changes: grows with each snapshot and each change of the status.
        since_ns: when each of its problems was first seen, by what it is; see :func:`skinware.views.tree.problems_of`.
    """

    def __init__(self, number: int, live: LiveDriver, namespace: str) -> None:
        self.number, self.live, self.namespace = number, live, namespace
        self.life = STARTING
        self.changes = 0
        self.since_ns: dict[tuple[object, ...], int] = {}
        self.taken_ns = self._judged_ns = 0
        self._calm_pair: tuple[Structure | None, Structure | None, bool] = (None, None, False)
        self.newest: Newest | None = None
        self.structure, self.generation = live.structure, live.reader.generation
        self.quantities = quantities_of(self.structure)
        self.past, self.rest = RecentValues(self.structure.n_sensors, self.structure.dtype), DriverRest(self.structure)

    @property
    def name(self) -> str:
        return self.live.name

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
        return report_of(live.reader, self.frame, live.rate_hz, live.patch_rates_hz, life=self.life, status=self.status)

    def take(self, frame: DriverSnapshot, services: TactileServices) -> None:
        if frame.structure is not self.structure and frame.structure != self.structure:
            self.structure, self.generation = frame.structure, frame.generation
            self.quantities = quantities_of(self.structure)
            self.past = RecentValues(self.structure.n_sensors, self.structure.dtype)
            self.rest = DriverRest(self.structure)
        self.taken_ns, self.life = now_ns(), LIVE
        self.past.add(frame.values, frame.published_ns)
        self.newest = self._judged(frame, services)
        self.rest.follow(self.newest.all_physical(), self.newest.status == 0, frame.published_ns)
        self.changes += 1

    def judge(self, services: TactileServices) -> None:
        """Judge again a driver that has published nothing newer."""
        before = self.newest
        if before is None or now_ns() - self._judged_ns < _JUDGE_EVERY_NS:
            return
        life, self.life = self.life, life_of(self.live.reader, before.frame)
        self.newest = self._judged(before.frame, services)
        if (
            self.life != life
            or not np.array_equal(self.newest.status, before.status)
            or (self.newest.contacts is None) != (before.contacts is None)
        ):
            self.changes += 1

    def _judged(self, frame: DriverSnapshot, services: TactileServices) -> Newest:
        self._judged_ns = now_ns()
        status, calm = status_now(self.life, frame), services.calm_of(self.name)
        if calm is not None and not self._fits(calm.structure):
            calm = None
        if calm is not None:
            status = status | (calm.status & _UNHEALTHY)
        return Newest(frame, status, calm, services.contacts_of(self.name), services.motion_of(self.name))

    def _fits(self, calm: Structure) -> bool:
        """Return whether a calmed driver has the same sensors; the comparison is made once for two structures."""
        known_calm, known, fits = self._calm_pair
        if known_calm is not calm or known is not self.structure:
            fits = np.array_equal(calm.sensor_uid, self.structure.sensor_uid) and np.array_equal(
                calm.sensor_type, self.structure.sensor_type
            )
            self._calm_pair = calm, self.structure, fits
        return fits


class Follower:
    """All drivers of a namespace, and what services publish about them.

    Args:
        calm: namespace of calmed drivers; None: without it.

    Attributes:
        edition: changes whenever drivers or structures change.
        services: about the drivers.
    """

    def __init__(
        self,
        namespace: Namespace,
        names: Collection[str] = (),
        calm: Namespace | None = None,
        robot: Robot | None = None,
    ) -> None:
        self.namespace, self.names, self.calm_namespace = namespace, tuple(names), calm
        self.drivers: list[ShownDriver] = []
        self.problem: str | None = None
        self.edition = 0
        self.robot = robot or Robot()
        self.scene = Scene({}, self.robot.poses)
        self._numbers: dict[str, int] = {}
        self._live = LiveDrivers(namespace, names)
        self.services = TactileServices(self._live, names, calm)

    def get(self, number: int) -> ShownDriver | None:
        return next((driver for driver in self.drivers if driver.number == number), None)

    def take(self, period_ns: int) -> list[ShownDriver]:
        """Take newer snapshots without waiting.

        Args:
            period_ns: shortest time between two snapshots of a driver.

        Returns:
            The drivers with a newer snapshot; their ``changes``, and ``edition``, show what else has changed.
        """
        self.problem = None
        try:
            found = self._live.look()
            self.services.look()
        except NamespaceError as error:
            self.problem = str(error)
            return []
        if [driver.live for driver in self.drivers] != found:
            kept = {id(driver.live): driver for driver in self.drivers}
            self.drivers = [kept.get(id(live)) or self._begin(live) for live in found]
            self._arrange()
        generations = [driver.generation for driver in self.drivers]
        newer = [driver for driver in self.drivers if self._take(driver, period_ns)]
        if generations != [driver.generation for driver in self.drivers]:
            self._arrange()
        return newer

    def close(self) -> None:
        self.services.close()
        self._live.close()
        self.drivers = []

    def _take(self, driver: ShownDriver, period_ns: int) -> bool:
        if now_ns() - driver.taken_ns < period_ns - _EARLY_NS:
            return False
        live = driver.live
        if live.frame is driver.frame:
            self._live.poll(live)
        if live.frame is None or live.frame is driver.frame:
            driver.judge(self.services)
        elif self.services.is_due(live):
            driver.take(live.frame, self.services)
            return True
        return False

    def _begin(self, live: LiveDriver) -> ShownDriver:
        number = self._numbers.setdefault(live.name, len(self._numbers))
        return ShownDriver(number, live, self.namespace.name)

    def _arrange(self) -> None:
        self.edition += 1
        self.scene = Scene(
            {driver.name: (driver.structure, driver.quantities) for driver in self.drivers}, self.robot.poses
        )
