"""Publish contacts, motion and health beside a calmed driver."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, NameInUse
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.baseline import SIGNED_TYPES, UNUSABLE
from skinware.tactile.chain import BaselineStage, Chain, ChainState
from skinware.tactile.chain_health import ChainHealth
from skinware.tactile.contacts_service import ContactsWriter
from skinware.tactile.health_service import RATE_HZ, HealthWriter
from skinware.tactile.motion_service import NAME, MotionWriter
from skinware.tactile.regions import Regions

log: logging.Logger = logging.getLogger("skinware.calm")

Writer = TypeVar("Writer")

_FIRST_CHOICE = "pressure"


@dataclass(frozen=True)
class WatchedRegions:
    """Regions whose motion is published.

    Attributes:
        regions: them.
        name: of the service.
    """

    regions: Regions
    name: str = NAME


def named_beside(driver: str, name: str, make: Callable[[str], Writer]) -> Writer:
    """Make a service beside a calmed driver; if another program has the name, with the driver's name before it.

    Args:
        driver: name of the driver.
        name: of the service.
        make: makes it, under the name that it is given.

    Raises:
        NameInUse: another program has both names.
        ConfigurationError: the longer name is too long.
    """
    try:
        return make(name)
    except NameInUse:
        return make(f"{driver}-{name}")


class CalmContacts:
    """The service of contacts of one calmed driver; of sensors that say how hard they are touched, pressure first.

    Args:
        name: of the service.
        driver: name of the driver.
        into: namespace of the calmed driver.
        group: whose members may read it.
        watched: regions whose motion is published beside it; None: none.

    Attributes:
        type_name: sensors whose contacts are published; empty: none, for the driver has no such sensors, or another
            program has the name.
        count: number of contacts in the newest frame.
    """

    def __init__(
        self,
        name: str,
        driver: str,
        into: Namespace,
        group: str | None = None,
        watched: WatchedRegions | None = None,
    ) -> None:
        self.type_name, self.count = "", 0
        self._name = name
        self._watched = watched
        self._driver, self._into, self._group = driver, into, group
        self._chain: Chain | None = None
        self._stage: BaselineStage | None = None
        self._writer: ContactsWriter | None = None
        self._motion: MotionWriter | None = None

    @property
    def name(self) -> str:
        """Name of the service; empty: there is none."""
        return "" if self._writer is None else self._writer.name

    @property
    def motion_name(self) -> str:
        """Name of the service of motion; empty: there is none."""
        return "" if self._motion is None else self._motion.name

    def follow(self, chain: Chain, rate_hz: float | None) -> None:
        """Go on with another chain, of other sensors.

        Args:
            chain: whose values come from now on.
            rate_hz: nominal rate of the driver.
        """
        stages = {
            name: stage
            for name, of_type in chain.stages.items()
            for stage in of_type
            if isinstance(stage, BaselineStage) and not name.startswith(SIGNED_TYPES)
        }
        type_name = _FIRST_CHOICE if _FIRST_CHOICE in stages else next(iter(stages), "")
        self._chain, self._stage, self.count = chain, stages.get(type_name), 0
        try:
            if self._writer is not None and type_name == self.type_name:
                self._writer.restructure(chain.structure)
            else:
                self.close()
                self._writer = self._made(chain.structure, type_name, rate_hz) if type_name else None
        except (ConfigurationError, NameInUse) as error:  # places without neighbours; another program's contacts
            self._give_up(error)
        self.type_name = type_name if self._writer is not None else ""
        self._follow_regions(chain.structure, rate_hz)

    def publish(self, values: npt.NDArray[np.float32], status: npt.NDArray[np.uint8], acquired_ns: int) -> None:
        """Find the contacts of the next frame, and publish them.

        Args:
            values: (n_sensors,) what came out of the chain.
            status: (n_sensors,) likewise; sensors that say nothing now touch nothing.
            acquired_ns: of the frame.
        """
        if self._writer is None or self._chain is None or self._stage is None:
            return
        index = self._chain.structure.index(self.type_name)
        usable = (status[index] & UNUSABLE) == 0
        try:
            found = self._writer.publish(values[index], self._stage.touched & usable, acquired_ns)
            if self._motion is not None:
                self._motion.publish(found, values[index], acquired_ns)
        except NameInUse as error:
            self._give_up(error)
        else:
            self.count = len(found)

    def publish_none(self, time_ns: int) -> None:
        """Say that nothing is touched: the driver is dead."""
        if self._chain is not None:
            n = self._chain.structure.n_sensors
            self.publish(np.zeros(n, np.float32), np.full(n, np.uint8(UNUSABLE)), time_ns)

    def close(self) -> None:
        for writer in (self._motion, self._writer):
            if writer is not None:
                writer.close()
        self._motion = self._writer = None
        self.type_name, self.count = "", 0

    def _made(self, structure: Structure, type_name: str, rate_hz: float | None) -> ContactsWriter:
        return named_beside(
            self._driver,
            self._name,
            lambda name: ContactsWriter(
                structure,
                type_name,
                driver=self._driver,
                name=name,
                namespace=self._into,
                rate_hz=rate_hz,
                group=self._group,
            ),
        )

    def _follow_regions(self, structure: Structure, rate_hz: float | None) -> None:
        if self._motion is not None:
            self._motion.close()
            self._motion = None
        if self._watched is None or self._writer is None:
            return
        try:
            frames, regions = self._writer.frames, self._watched.regions
            self._motion = named_beside(
                self._driver,
                self._watched.name,
                lambda name: MotionWriter(
                    structure,
                    self.type_name,
                    regions,
                    frames,
                    driver=self._driver,
                    name=name,
                    namespace=self._into,
                    rate_hz=rate_hz,
                    group=self._group,
                ),
            )
        except (ConfigurationError, NameInUse) as error:  # no region of such sensors; another program's motion
            log.warning("no motion of %r: %s", self._driver, str(error))

    def _give_up(self, error: Exception) -> None:
        """Calm values are worth more than contacts: go on without these."""
        self.close()
        log.warning("no contacts of %r: %s", self._driver, str(error))


_PERIOD_NS = round(NS_PER_S / RATE_HZ)


class CalmHealth:
    """The service of health of one calmed driver, for all types that have a baseline and that a touch only raises.

    Args:
        name: of the service.
        driver: name of the driver.
        into: namespace of the calmed driver.
        group: whose members may read it.

    Attributes:
        faulty: number of sensors with a fault.
    """

    def __init__(self, name: str, driver: str, into: Namespace, group: str | None = None) -> None:
        self.faulty = 0
        self._name = name
        self._driver, self._into, self._group = driver, into, group
        self._health: ChainHealth | None = None
        self._writer: HealthWriter | None = None
        self._status: npt.NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._due_ns = 0

    @property
    def name(self) -> str:
        """Name of the service; empty: there are no such sensors, or another program has the name."""
        return "" if self._writer is None else self._writer.name

    def follow(self, chain: Chain) -> None:
        """Go on with another chain, of other sensors: of which nothing is known yet, unless it is restored.

        Args:
            chain: whose values come from now on.
        """
        self._health, self.faulty = ChainHealth(chain, self._driver), 0
        self._status = np.zeros(chain.structure.n_sensors, np.uint8)
        try:
            if not self._health:
                self.close()
            elif self._writer is not None:
                self._writer.restructure(chain.structure)
            elif self._name:
                self._writer = named_beside(
                    self._driver,
                    self._name,
                    lambda name: HealthWriter(
                        chain.structure, self._driver, name=name, namespace=self._into, group=self._group
                    ),
                )
        except (ConfigurationError, NameInUse) as error:
            self._give_up(error)

    def state(self) -> dict[str, dict[str, npt.NDArray[Any]]]:
        """What is known, by type: arrays by name, and ``uid``."""
        return {} if self._health is None else self._health.state()

    def restore(self, state: ChainState) -> None:
        """Go on with what was known of the sensors of this chain, if its baselines saw the same values then.

        Raises:
            ConfigurationError: that is no such state.
        """
        if self._health is not None:
            self._health.restore(state)

    def step(self, status: npt.NDArray[np.uint8], acquired_ns: int) -> None:
        """Take in what the chain made of the next frame; mark sensors with a fault as ``UNHEALTHY``.

        Args:
            status: (n_sensors,) what came out of the chain, changed in place.
            acquired_ns: of the frame.
        """
        if self._health is None:
            return
        self._health.update(acquired_ns)
        if acquired_ns >= self._due_ns:
            self._due_ns = acquired_ns + _PERIOD_NS
            self._tell(self._health, acquired_ns)
        status |= self._status

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer = None

    def _tell(self, health: ChainHealth, acquired_ns: int) -> None:
        reports = health.reports()
        self._status = np.uint8(Status.UNHEALTHY) * health.faulty(reports)
        self.faulty = int(np.count_nonzero(self._status))
        if self._writer is not None:
            try:
                self._writer.publish(reports, acquired_ns)
            except NameInUse as error:
                self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        """Calm values are worth more than this service: go on without it."""
        self.close()
        self._name = ""
        log.warning("no health of %r: %s", self._driver, str(error))
