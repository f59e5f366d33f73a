"""Judge the health of all sensors of a driver, by the values before and after the baselines of its chain."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.chain import BaselineStage, Chain, ChainState
from skinware.tactile.health import Health, HealthReport

log: logging.Logger = logging.getLogger("skinware.calm")


class ChainHealth:
    """Follows the health of all types of a chain that have a baseline and that a touch only raises.

    Args:
        chain: the chain whose values it judges.
        driver: name of the driver, for messages.
    """

    def __init__(self, chain: Chain, driver: str) -> None:
        self._chain = chain
        self._watched: dict[str, tuple[BaselineStage, Health]] = {}
        structure = chain.structure
        for name, stage in chain.baseline_stages.items():
            taxels = stage.before
            if taxels.signed:
                continue
            geometry = None if structure.geometry is None else structure.geometry[structure.index(name)]
            limits = taxels.type.minimum, taxels.type.maximum
            try:
                health = Health(taxels.module, geometry, resolution=taxels.resolution, limits=limits)
            except ConfigurationError as error:  # places without neighbours
                log.warning("%s of %r: dead and weak sensors are not found: %s", name, driver, error)
                health = Health(taxels.module, resolution=taxels.resolution, limits=limits)
            self._watched[name] = stage, health

    def __bool__(self) -> bool:
        return bool(self._watched)

    def update(self, time_ns: int) -> None:
        """Take in what the chain made of the frame of this time."""
        for stage, health in self._watched.values():
            if stage.calm is not None:
                health.update(time_ns, stage.given, stage.calm)

    def reports(self) -> dict[str, HealthReport]:
        """Judge the sensors of each type, in the order of ``structure.index``."""
        return {name: health.report() for name, (_, health) in self._watched.items()}

    def state(self) -> dict[str, dict[str, npt.NDArray[Any]]]:
        """Return what is known, by type: arrays by name, and ``uid``."""
        structure = self._chain.structure
        return {
            name: {"uid": structure.sensor_uid[structure.index(name)], **health.state()}
            for name, (_, health) in self._watched.items()
        }

    def restore(self, state: ChainState) -> None:
        """Go on with what was known of these sensors, if the baselines saw the same values then.

        Raises:
            ConfigurationError: that is no such state.
        """
        if self._chain.fits(state):
            for name, (_, health) in self._watched.items():
                if name in state.health:
                    known = state.health[name]
                    health.restore(known, self._chain.rows_of(name, known["uid"]))

    def faulty(self, reports: dict[str, HealthReport]) -> npt.NDArray[np.bool_]:
        """Return (n_sensors,) bool: the sensors of the driver that have a fault in ``reports``."""
        found = np.zeros(self._chain.structure.n_sensors, bool)
        for name, report in reports.items():
            found[self._chain.structure.index(name)] = report.faulty
        return found
