"""Health of all sensors of a driver, judged by what goes into the baselines of a chain and what comes out of them."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.baseline import SIGNED_TYPES
from skinware.tactile.chain import BaselineStage, Chain, ChainState
from skinware.tactile.health import Health
from skinware.tactile.health_report import HealthReport

log: logging.Logger = logging.getLogger("skinware.calm")


class ChainHealth:
    """Follows the health of all types of a chain that have a baseline and that a touch only raises.

    Args:
        chain: whose values it judges.
        driver: name of the driver, for messages.
    """

    def __init__(self, chain: Chain, driver: str) -> None:
        self._chain = chain
        self._watched: dict[str, tuple[BaselineStage, Health]] = {}
        for name, stages in chain.stages.items():
            stage = next((stage for stage in stages if isinstance(stage, BaselineStage)), None)
            if stage is not None and not name.startswith(SIGNED_TYPES):
                self._watched[name] = stage, _health(chain, driver, name, stage)

    def __bool__(self) -> bool:
        return bool(self._watched)

    def update(self, time_ns: int) -> None:
        """Take in what the chain made of the next frame.

        Args:
            time_ns: of the frame, as for the baselines.
        """
        for stage, health in self._watched.values():
            if stage.calm is not None:
                health.update(time_ns, stage.given, stage.calm)

    def reports(self) -> dict[str, HealthReport]:
        """What is known now of the sensors of each type, in the order of ``structure.index``."""
        return {name: health.report() for name, (_, health) in self._watched.items()}

    def state(self) -> dict[str, dict[str, npt.NDArray[Any]]]:
        """What is known, by type: arrays by name, and ``uid``."""
        structure = self._chain.structure
        return {
            name: {"uid": structure.sensor_uid[structure.index(name)], **health.state()}
            for name, (_, health) in self._watched.items()
        }

    def restore(self, state: ChainState) -> None:
        """Go on with what was known of these sensors, if the baselines of then saw the same values.

        Raises:
            ConfigurationError: that is no such state.
        """
        if self._chain.fits(state):
            for name, (_, health) in self._watched.items():
                if name in state.health:
                    known = state.health[name]
                    health.restore(known, self._chain.rows_of(name, known["uid"]))

    def faulty(self, reports: dict[str, HealthReport]) -> npt.NDArray[np.bool_]:
        """(n_sensors,) bool: which sensors of the driver have a fault, as ``reports`` said."""
        found = np.zeros(self._chain.structure.n_sensors, bool)
        for name, report in reports.items():
            found[self._chain.structure.index(name)] = report.faulty
        return found


def _health(chain: Chain, driver: str, type_name: str, stage: BaselineStage) -> Health:
    structure, taxels = chain.structure, stage.before
    geometry = None if structure.geometry is None else structure.geometry[structure.index(type_name)]
    limits = taxels.type.minimum, taxels.type.maximum
    try:
        return Health(taxels.module, geometry, resolution=taxels.resolution, limits=limits)
    except ConfigurationError as error:  # places without neighbours
        log.warning("%s of %r: dead and weak sensors are not found: %s", type_name, driver, error)
        return Health(taxels.module, resolution=taxels.resolution, limits=limits)
