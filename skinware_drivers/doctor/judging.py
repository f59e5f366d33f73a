"""Judge which taxels are noisy, stuck or dead, and which rows and columns of matrices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.matrices import filled_by
from skinware.structure import Structure
from skinware.tactile.chain import ChainSettings
from skinware.tactile.chain_health import ChainHealth
from skinware.tactile.health import HealthKind, HealthReport
from skinware_drivers.doctor.evidence import HealthSeen, TaxelFault


def whole_lines(structure: Structure, bad: npt.NDArray[np.bool_]) -> tuple[str, ...]:
    """Names of the rows and columns that are all bad, and of the matrices that are, counted from 0.

    Args:
        structure: whose modules are matrices where their kind says so: ``12x32``.
        bad: (n_sensors,) of each sensor.
    """
    found: list[str] = []
    for module, name in enumerate(structure.module_names):
        kind = structure.module_kind[module].decode()
        index = np.arange(structure.n_sensors)[structure.module_index(module)]
        for type_id in np.unique(structure.sensor_type[index]).tolist():
            of_type = bad[index[structure.sensor_type[index] == type_id]]
            shape = filled_by(kind, len(of_type))
            if shape is not None:
                found += [f"{line} of {name}" for line in _lines(of_type.reshape(shape))]
    return tuple(dict.fromkeys(found))


def _lines(bad: npt.NDArray[np.bool_]) -> list[str]:
    if bad.all():
        return ["all"]
    if 1 in bad.shape:
        return []
    rows, columns = (np.flatnonzero(bad.all(axis=axis)).tolist() for axis in (1, 0))
    return [*(f"row {row}" for row in rows), *(f"column {column}" for column in columns)]


_PERIOD_NS = 45_000_000
"""Frames that come faster than that say nothing more of a taxel's health."""
_STUCK_S = 600.0


class TaxelJudge:
    """Judges the taxels of one structure by its frames.

    Args:
        structure: of the driver.
        driver: name of the driver.
    """

    def __init__(self, structure: Structure, driver: str) -> None:
        self._structure = structure
        self._first_ns = self._due_ns = self._last_ns = 0
        self._why_not = ""
        self._values: npt.NDArray[np.float32] = np.zeros(structure.n_sensors, np.float32)
        self._status: npt.NDArray[np.uint8] = np.zeros(structure.n_sensors, np.uint8)
        try:
            self._chain = ChainSettings.calm().chain(structure)
        except ConfigurationError:
            self._why_not = "no sensor of it has a rest to go back to"
            return
        self._health = ChainHealth(self._chain, driver)

    def take(self, frame: DriverSnapshot) -> None:
        """Take in the next frame; those that come too soon after another are left out."""
        if self._why_not or frame.acquired_ns < self._due_ns:
            return
        self._first_ns = self._first_ns or frame.acquired_ns
        self._last_ns, self._due_ns = frame.acquired_ns, frame.acquired_ns + _PERIOD_NS
        with np.errstate(all="ignore"):  # values may be any that a file or a device gives
            self._chain.step(frame, self._values, self._status)
            self._health.update(frame.acquired_ns)

    def seen(self) -> HealthSeen:
        if self._why_not or not self._health:
            return HealthSeen("", 0, (), {"health": self._why_not or "it has no such sensors"})
        faults: list[TaxelFault] = []
        with np.errstate(all="ignore"):
            reports = self._health.reports()
        known_noise = untouched = judged = 0
        for name, report in reports.items():
            positions = np.arange(self._structure.n_sensors)[self._structure.index(name)]
            faults += _faults(self._structure, positions, report, self._structure.type(name).unit)
            judged += len(positions)
            known_noise += int(np.isfinite(report.noise).sum())
            untouched += int((report.kind == HealthKind.NEVER_TOUCHED).sum())
        missing = {}
        seconds = (self._last_ns - self._first_ns) / 1e9
        if not known_noise:
            missing["noisy and clipped taxels"] = f"that takes 10 s without a touch, and these were {seconds:.0f} s"
        if seconds < _STUCK_S:
            missing["stuck taxels"] = f"that takes {_STUCK_S / 60:.0f} min of use, and these were {seconds:.0f} s"
        if untouched or not faults:
            missing["dead and weak taxels"] = f"nothing has touched {untouched:,} of {judged:,} meanwhile"
        return HealthSeen("these frames", judged, tuple(faults), missing)


def _faults(
    structure: Structure, positions: npt.NDArray[np.int64], report: HealthReport, unit: str
) -> list[TaxelFault]:
    return [
        TaxelFault(
            structure.sensor_name(int(positions[row])),
            HealthKind(int(report.kind[row])).name.lower(),
            report.evidence(row, unit),
        )
        for row in np.flatnonzero(report.faulty).tolist()
    ]
