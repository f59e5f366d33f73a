"""What all viewers look at, taken once for all of them: drivers, their newest frames, and what is calm of them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import NamespaceError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, now_ns
from skinware.state import LIVE, STARTING, life_of, status_now
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.contacts_service import ContactsSample
from skinware.tactile.motion_service import MotionSample
from skinware.views.beside import Beside
from skinware.views.live import LiveDriver, LiveDrivers
from skinware.views.quantities import Past, Quantity, Rest, quantities_of
from skinware.views.robot import Robot
from skinware.views.scene import Scene

_JUDGE_EVERY_NS = NS_PER_S // 5
_SLACK_NS = 5_000_000
"""A frame may be taken so much earlier than the pace says."""
_UNHEALTHY = np.uint8(Status.UNHEALTHY)


class Followed:
    """A driver as all viewers see it.

    Args:
        number: by which viewers know it, over its restarts too.
        live: its reader.
        namespace: where it is.

    Attributes:
        structure: of what is shown.
        quantities: the pictures that there are of it.
        generation: in which the driver came with this structure.
        frame: its newest; None before the first.
        life: what it is doing; see :func:`skinware.state.life_of`.
        status: (n_sensors,) uint8, status of its sensors now, with what the calmed driver knows of their health.
        changes: counts frames and changes of status.
        past: its values of the last seconds.
        rest: what its sensors read at rest.
        contacts: on it; None where nobody tells any.
        motion: over its regions, likewise.
    """

    def __init__(self, number: int, live: LiveDriver, namespace: str) -> None:
        self.number, self.live, self.namespace = number, live, namespace
        self.frame: DriverSnapshot | None = None
        self.life = STARTING
        self.changes = 0
        self.taken_ns = 0
        self._judged_ns = 0
        self.contacts: ContactsSample | None = None
        self.motion: MotionSample | None = None
        self._calm: DriverSnapshot | None = None
        self._calm_structure: Structure | None = None
        self._calm_fits = False
        self._shared: dict[object, Any] = {}
        self._take_structure(live.structure, live.reader.generation)

    @property
    def name(self) -> str:
        return self.live.name

    def quantity(self, name: str) -> Quantity | None:
        """The picture of this name; None where there is none."""
        return next((quantity for quantity in self.quantities if quantity.name == name), None)

    def take(self, frame: DriverSnapshot, beside: Beside) -> None:
        """Go on to a newer frame.

        Args:
            frame: it.
            beside: what services tell beside it.
        """
        if frame.structure is not self.structure and frame.structure != self.structure:
            self._take_structure(frame.structure, frame.generation)
        self.frame, self.taken_ns, self.life = frame, now_ns(), LIVE
        self.past.add(frame.values, frame.published_ns)
        self._judge(frame, beside)
        self.rest.follow(self.all_physical(), self.status == 0, frame.published_ns)
        self.changes += 1

    def judge(self, beside: Beside) -> None:
        """Look what has become of a driver that says nothing new."""
        if self.frame is not None and now_ns() - self._judged_ns >= _JUDGE_EVERY_NS:
            before = self.life, self.status, self.contacts
            self.life = life_of(self.live.reader, self.frame)
            self._judge(self.frame, beside)
            if (
                self.life != before[0]
                or not np.array_equal(self.status, before[1])
                or (self.contacts is None) != (before[2] is None)
            ):
                self.changes += 1

    def shared(self, key: object, make: Callable[[], Any]) -> Any:
        """What several viewers need of the newest frame, made once."""
        if key not in self._shared:
            self._shared[key] = make()
        return self._shared[key]

    def physical(self, quantity: Quantity) -> npt.NDArray[np.floating[Any]]:
        """(n,): values of a quantity's sensors in its unit."""
        frame = self.frame
        assert frame is not None  # noqa: S101 - nobody looks at a driver without frames
        return self.shared(("physical", quantity.name), lambda: frame.physical(quantity.type.name))  # type: ignore[no-any-return]

    def all_physical(self) -> npt.NDArray[np.float32]:
        """(n_sensors,) float32: values of the sensors of all types, each in its unit."""
        return self.shared("all", self._all_physical)  # type: ignore[no-any-return]

    def calm(self, quantity: Quantity) -> npt.NDArray[np.floating[Any]] | None:
        """(n,): how far each of them is above its baseline, 0 where nothing touches; None where nobody knows."""
        frame = self._calm_frame
        if frame is None:
            return None
        return self.shared(("calm", quantity.name), lambda: frame.physical(quantity.type.name))  # type: ignore[no-any-return]

    def contact_of(self, quantity: Quantity) -> npt.NDArray[np.int16] | None:
        """(n,) int16: row of the contact of each sensor of a quantity, below 0: none; None where nobody tells any."""
        frame = self.contacts
        if frame is None or frame.source.type_name != quantity.type.name:
            return None
        if not np.array_equal(frame.source.uid, self.structure.sensor_uid[quantity.where]):
            return None
        return frame.contacts.contact_of

    @property
    def _calm_frame(self) -> DriverSnapshot | None:
        """The newest frame of the calmed driver, if it is of the same sensors and lives."""
        frame = self._calm
        if frame is None:
            return None
        if frame.structure is not self._calm_structure:
            self._calm_structure = frame.structure
            self._calm_fits = np.array_equal(frame.structure.sensor_uid, self.structure.sensor_uid) and np.array_equal(
                frame.structure.sensor_type, self.structure.sensor_type
            )
        return frame if self._calm_fits else None

    def _all_physical(self) -> npt.NDArray[np.float32]:
        assert self.frame is not None  # noqa: S101 - nobody looks at a driver without frames
        physical = np.empty(self.structure.n_sensors, np.float32)
        for sensor_type in self.structure.types:
            physical[self.structure.index(sensor_type.name)] = self.frame.physical(sensor_type.name)
        return physical

    def _take_structure(self, structure: Structure, generation: int) -> None:
        self.structure, self.generation = structure, generation
        self.quantities = quantities_of(structure)
        self.status: npt.NDArray[np.uint8] = np.full(structure.n_sensors, int(Status.NEVER_SEEN), np.uint8)
        self.past, self.rest = Past(structure.n_sensors, structure.dtype), Rest(structure)
        self._calm_structure = None

    def _judge(self, frame: DriverSnapshot, beside: Beside) -> None:
        self._judged_ns = now_ns()
        self._calm = beside.calm_of(self.name)
        self.contacts, self.motion = beside.contacts_of(self.name), beside.motion_of(self.name)
        self._shared.clear()
        self.status = status_now(self.life, frame)
        calm = self._calm_frame
        if calm is not None:
            self.status = self.status | (calm.status & _UNHEALTHY)


class Follower:
    """All drivers of a namespace, and what services tell beside them.

    Args:
        namespace: of the drivers.
        names: of those to follow; default: all.
        calm: namespace where calmed drivers are; None: nowhere.
        robot: under the skin.

    Attributes:
        namespace, names, calm_namespace, robot: as given.
        drivers: all there are, by name.
        scene: where their taxels are.
        edition: another one whenever drivers or structures are others.
        problem: why nothing can be seen; None: all is well.
    """

    def __init__(
        self,
        namespace: Namespace,
        names: Collection[str] = (),
        calm: Namespace | None = None,
        robot: Robot | None = None,
    ) -> None:
        self.namespace, self.names, self.calm_namespace = namespace, tuple(names), calm
        self.drivers: list[Followed] = []
        self.problem: str | None = None
        self.edition = 0
        self.robot = robot or Robot()
        self.scene = Scene({}, self.robot.poses)
        self._numbers: dict[str, int] = {}
        self._live = LiveDrivers(namespace, names)
        self._beside = Beside(self._live, names, calm)

    def get(self, number: int) -> Followed | None:
        return next((driver for driver in self.drivers if driver.number == number), None)

    def take(self, period_ns: int) -> list[Followed]:
        """Take what is new; never waits.

        Args:
            period_ns: no driver's frames are taken more often.

        Returns:
            The drivers with a newer frame; their ``changes`` and ``edition`` tell what else there is to be seen.
        """
        try:
            newer, self.problem = self._take(period_ns), None
        except NamespaceError as error:
            newer, self.problem = [], str(error)
        return newer

    def close(self) -> None:
        self._beside.close()
        self._live.close()
        self.drivers = []

    def _take(self, period_ns: int) -> list[Followed]:
        found = self._live.look()
        self._beside.look()
        self._keep(found)
        newer = []
        generations = [driver.generation for driver in self.drivers]
        for driver in self.drivers:
            if now_ns() - driver.taken_ns < period_ns - _SLACK_NS:
                continue
            live = driver.live
            if live.frame is driver.frame:  # the last one is shown
                self._live.poll(live)
            if live.frame is None or live.frame is driver.frame:
                driver.judge(self._beside)
            elif self._beside.is_due(live):
                driver.take(live.frame, self._beside)
                newer.append(driver)
        if generations != [driver.generation for driver in self.drivers]:
            self._arrange()
        return newer

    def _keep(self, found: list[LiveDriver]) -> None:
        if [driver.live for driver in self.drivers] == found:
            return
        kept = {id(driver.live): driver for driver in self.drivers}
        self.drivers = [kept.get(id(live)) or self._begin(live) for live in found]
        self._arrange()

    def _begin(self, live: LiveDriver) -> Followed:
        number = self._numbers.setdefault(live.name, len(self._numbers))
        return Followed(number, live, self.namespace.name)

    def _arrange(self) -> None:
        self.edition += 1
        self.scene = Scene(
            {driver.name: (driver.structure, driver.quantities) for driver in self.drivers}, self.robot.poses
        )
