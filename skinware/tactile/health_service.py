"""Judge all sensors of a driver; publish and read it: the service ``health``, once a second, with the reasons.

Columns of a sample: those of :data:`skinware.tactile.health.COLUMNS`, of all sensors of the driver in the order
of its samples. Nothing is known of types without a rest: ``kind`` is 0 and numbers are NaN. Static columns:
``sensor_uid``, ``sensor_type``, and the name of the ``driver``.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Unpack

import numpy as np

from skinware.errors import ConfigurationError
from skinware.structure import Structure
from skinware.tactile.arrays import Flags, rows_of
from skinware.tactile.chain import HEALTH, BaselineStage, Chain
from skinware.tactile.health import COLUMNS, NOTHING, Health, HealthReport
from skinware.tactile.source_service import (
    ServiceForm,
    ServiceOptions,
    Source,
    SourceReader,
    SourceSample,
    SourceWriter,
)

log: logging.Logger = logging.getLogger("skinware.calm")

NAME = "health"
RATE_HZ = 1.0
"""How often it is published."""

_FORM = ServiceForm(NAME, ("driver", "uid", "type_id"), lambda source: rows_of(COLUMNS, len(source.uid)))


class HealthSample(SourceSample):
    """The health of all sensors at one time."""

    __slots__ = ()

    @property
    def report(self) -> HealthReport:
        """It as arrays of all sensors of the driver."""
        return HealthReport(**{name: self.column(name) for name in COLUMNS})


class HealthReader(SourceReader[HealthSample]):
    """Reads the service ``health``: a :class:`skinware.service.ServiceReader` whose samples are reports.

    Raises:
        BadServiceFile: the service is of another kind.
    """

    form = _FORM
    frame_class = HealthSample


class HealthWriter(SourceWriter):
    """Publishes the health of the sensors of a driver, whose name is for readers.

    Options are namespace and group, as for :class:`skinware.service.ServiceWriter`.
    """

    form = _FORM

    def __init__(
        self, structure: Structure, driver: str, *, name: str = NAME, **options: Unpack[ServiceOptions]
    ) -> None:
        self._structure = structure
        source = Source(driver, uid=structure.sensor_uid, type_id=structure.sensor_type)
        given: ServiceOptions = {"slots": 4, "rate_hz": RATE_HZ, **options}
        super().__init__(source, name, **given)

    def publish(self, reports: Mapping[str, HealthReport], acquired_ns: int) -> None:
        """Publish the present reports by type of sensors; nothing is known of the others.

        Raises:
            StructureError: the driver has no such sensors.
            Closed, Paused, NameInUse: as ``begin``.
        """
        columns = self.begin()
        for name, nothing in NOTHING.items():
            columns[name][:] = nothing
            for type_name, report in reports.items():
                index, values = self._structure.index(type_name), getattr(report, name)
                if name == "other":
                    positions = np.arange(len(self._structure.sensor_uid))[index]
                    values = np.where(values >= 0, positions[values], values)
                columns[name][index] = values
        self.commit(acquired_ns)

    def go_on(self, structure: Structure) -> None:
        """Go on with other sensors, as a new generation; raises NamespaceError, and then the old one goes on."""
        self._go_on(Source(self.source.driver, uid=structure.sensor_uid, type_id=structure.sensor_type))
        self._structure = structure


class ChainHealth:
    """Follows the health of all types of a chain that have a baseline and that a touch only raises."""

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
            chain.keep(name, health, f"{HEALTH}{name}/")

    def __bool__(self) -> bool:
        return bool(self._watched)

    def update(self, time_ns: int) -> None:
        """Take in what the chain made of the sample of this time."""
        for stage, health in self._watched.values():
            if stage.calm is not None:
                health.update(time_ns, stage.given, stage.calm)

    def reports(self) -> dict[str, HealthReport]:
        """Judge the sensors of each type, in the order of ``structure.index``."""
        return {name: health.report() for name, (_, health) in self._watched.items()}

    def faulty(self, reports: dict[str, HealthReport]) -> Flags:
        """Return (n_sensors,) bool: the sensors of the driver that have a fault in ``reports``."""
        found = np.zeros(self._chain.structure.n_sensors, bool)
        for name, report in reports.items():
            found[self._chain.structure.index(name)] = report.faulty
        return found
