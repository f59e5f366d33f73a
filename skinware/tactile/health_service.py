"""The service ``health``: once a second, what is known of each sensor of a calmed driver, and why.

::

    with HealthReader(namespace="calm", timeout_s=10) as health:
        report = health.read().report
        for position in np.flatnonzero(report.faulty):
            print(health.source.uid[position], report.evidence(position))

Columns of a frame: those of :data:`skinware.tactile.health_report.COLUMNS`, of all sensors of the driver in the order
of its frames. Of types without a rest nothing is known: ``kind`` is 0 and numbers are NaN. Static columns:
``sensor_uid``, ``sensor_type``, and the name of the ``driver``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import texts
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.service import Column, ServiceWriter
from skinware.structure import Structure
from skinware.tactile.health_report import COLUMNS, HealthReport
from skinware.tactile.source_reader import SourceReader

KIND = NAME = "health"
RATE_HZ = 1.0
"""How often it is published."""

_TEXTS = {
    "kind": ("", "0: good, 1: never touched, 2: weak, 3: dead, 4: noisy, 5: stuck, 6: clipped"),
    "value": ("", "the newest, in the unit of the type"),
    "still_s": ("s", "for how long it has not changed"),
    "peak": ("", "the most that a touch showed, in the unit of the type"),
    "noise": ("", "standard deviation, in the unit of the type"),
    "noise_times": ("", "the same in those of the typical sensor"),
    "clipped": ("", "share of the time at an end of the range"),
    "touches": ("", "separate touches of both its sides"),
    "shown": ("", "what it showed of its due in them"),
    "shown_around": ("", "what its neighbours did; only where that is much more"),
}
_SLOTS = 4


@dataclass(frozen=True)
class HealthSource:
    """What health is told of.

    Attributes:
        driver: name of the driver.
        uid: (n,) uint64, of its n sensors, in the order of its frames.
        type_id: (n,) uint32, of their types.
    """

    driver: str
    uid: npt.NDArray[np.uint64]
    type_id: npt.NDArray[np.uint32]


class HealthSample(Sample):
    """What is known at one time."""

    __slots__ = ()

    @property
    def source(self) -> HealthSource:
        """What it is told of."""
        return cast(HealthSource, self.context)

    @property
    def report(self) -> HealthReport:
        """As arrays of all sensors of the driver."""
        return HealthReport(**{name: self.column(name) for name in COLUMNS})


class HealthReader(SourceReader[HealthSource, HealthSample]):
    """Reads the service ``health``: a :class:`skinware.service.ServiceReader` whose frames are reports.

    Args:
        name: of the service.
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Raises:
        BadServiceFile: the service is none of health.
    """

    kind = KIND
    frame_class = HealthSample

    @staticmethod
    def _source_of(static: Mapping[str, npt.NDArray[Any]]) -> HealthSource:
        uid, type_id = static["sensor_uid"].astype(np.uint64), static["sensor_type"].astype(np.uint32)
        if uid.shape != type_id.shape:
            raise ValueError(f"{len(uid)} uids of {len(type_id)} types")
        return HealthSource(texts(static["driver"])[0], uid, type_id)

    @staticmethod
    def _layout_of(source: HealthSource) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        return {name: (dtype, source.uid.shape) for name, (dtype, _) in COLUMNS.items()}


class HealthWriter:
    """Publishes what is known of the sensors of a driver.

    Args:
        structure: of the driver.
        driver: its name.
        name: of the service.
        namespace, group: as for :class:`skinware.service.ServiceWriter`, which also lists the errors.
    """

    def __init__(
        self,
        structure: Structure,
        driver: str,
        *,
        name: str = NAME,
        namespace: Namespace | str | None = None,
        group: str | None = None,
    ) -> None:
        self._structure, self._driver = structure, driver
        self._service = ServiceWriter(
            name,
            _columns(structure),
            self._static(structure),
            namespace=namespace,
            kind=KIND,
            slots=_SLOTS,
            rate_hz=RATE_HZ,
            group=group,
            description=f"health of the sensors of {driver}",
        )

    @property
    def name(self) -> str:
        """Name of the service."""
        return self._service.name

    def publish(self, reports: Mapping[str, HealthReport], acquired_ns: int) -> None:
        """Publish what is known now.

        Args:
            reports: by type of sensors; of the others nothing is known.
            acquired_ns: of the newest frame, CLOCK_MONOTONIC ns.

        Raises:
            StructureError: the driver has no such sensors.
            Closed, Paused, NameInUse: as :meth:`skinware.service.ServiceWriter.begin`.
        """
        columns = self._service.begin()
        for name, (_, nothing) in COLUMNS.items():
            columns[name][:] = nothing
            for type_name, report in reports.items():
                columns[name][self._structure.index(type_name)] = getattr(report, name)
        self._service.commit(acquired_ns)

    def restructure(self, structure: Structure) -> None:
        """Go on with other sensors, as a new generation; readers are told.

        Raises:
            NamespaceError: shared memory is full; the old generation then goes on.
        """
        self._service.restructure(_columns(structure), self._static(structure))
        self._structure = structure

    def close(self) -> None:
        """Withdraw the service. Idempotent."""
        self._service.close()

    def _static(self, structure: Structure) -> dict[str, npt.NDArray[Any]]:
        return {
            "sensor_uid": structure.sensor_uid,
            "sensor_type": structure.sensor_type,
            "driver": np.array([self._driver.encode()], "S64"),
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _columns(structure: Structure) -> dict[str, Column]:
    return {
        name: Column(np.dtype(dtype), (structure.n_sensors,), *_TEXTS[name]) for name, (dtype, _) in COLUMNS.items()
    }
