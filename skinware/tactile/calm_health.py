"""Health beside a calmed driver: judged by what goes into its baselines and what comes out of them."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, NameInUse
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.tactile.baseline import SIGNED_TYPES
from skinware.tactile.chain import BaselineStage, Chain
from skinware.tactile.health import Health
from skinware.tactile.health_service import RATE_HZ, HealthWriter

log: logging.Logger = logging.getLogger("skinware.calm")

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
        self._chain: Chain | None = None
        self._watched: dict[str, tuple[BaselineStage, Health]] = {}
        self._writer: HealthWriter | None = None
        self._status: npt.NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._due_ns = 0

    @property
    def name(self) -> str:
        """Name of the service; empty: there are no such sensors, or another program has the name."""
        return "" if self._writer is None else self._name

    def follow(self, chain: Chain) -> None:
        """Go on with another chain, of other sensors: of which nothing is known yet.

        Args:
            chain: whose values come from now on.
        """
        self._chain, self._watched, self.faulty = chain, {}, 0
        self._status = np.zeros(chain.structure.n_sensors, np.uint8)
        for name, stages in chain.stages.items():
            stage = next((stage for stage in stages if isinstance(stage, BaselineStage)), None)
            if stage is not None and not name.startswith(SIGNED_TYPES):
                self._watched[name] = stage, self._health(chain, name, stage)
        try:
            if not self._watched:
                self.close()
            elif self._writer is not None:
                self._writer.restructure(chain.structure)
            elif self._name:
                self._writer = HealthWriter(
                    chain.structure, self._driver, name=self._name, namespace=self._into, group=self._group
                )
        except NameInUse as error:
            self._give_up(error)

    def step(self, status: npt.NDArray[np.uint8], acquired_ns: int) -> None:
        """Take in what the chain made of the next frame; mark sensors with a fault as ``UNHEALTHY``.

        Args:
            status: (n_sensors,) what came out of the chain, changed in place.
            acquired_ns: of the frame.
        """
        if self._chain is None:
            return
        for stage, health in self._watched.values():
            if stage.calm is not None:
                health.update(acquired_ns, stage.given, stage.calm)
        if acquired_ns >= self._due_ns:
            self._due_ns = acquired_ns + _PERIOD_NS
            self._tell(self._chain, acquired_ns)
        status |= self._status

    def close(self) -> None:
        """Withdraw the service. Idempotent."""
        if self._writer is not None:
            self._writer.close()
        self._writer = None

    def _health(self, chain: Chain, type_name: str, stage: BaselineStage) -> Health:
        """For the values that a baseline gets."""
        structure, taxels = chain.structure, stage.before
        geometry = None if structure.geometry is None else structure.geometry[structure.index(type_name)]
        limits = taxels.type.minimum, taxels.type.maximum
        try:
            return Health(taxels.module, geometry, resolution=taxels.resolution, limits=limits)
        except ConfigurationError as error:  # places without neighbours
            log.warning("%s of %r: dead and weak sensors are not found: %s", type_name, self._driver, error)
            return Health(taxels.module, resolution=taxels.resolution, limits=limits)

    def _tell(self, chain: Chain, acquired_ns: int) -> None:
        reports = {name: health.report() for name, (_, health) in self._watched.items()}
        for name, report in reports.items():
            self._status[chain.structure.index(name)] = np.uint8(Status.UNHEALTHY) * report.faulty
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


__all__ = ["CalmHealth"]
