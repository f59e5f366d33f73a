"""Health beside a calmed driver: judged by what goes into its baselines and what comes out of them."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, NameInUse
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.tactile.calm_contacts import named_beside
from skinware.tactile.chain import Chain, ChainState
from skinware.tactile.chain_health import ChainHealth
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
