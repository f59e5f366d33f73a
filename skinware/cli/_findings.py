"""What is wrong with a geometry, by the names that people know."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.cli._format import plural
from skinware.structure import Structure
from skinware.tactile.calibration.checking import MIRRORED, OFF, SHARED, SWAPPED, TURNED, UNKNOWN, Finding


def finding_data(finding: Finding, structure: Structure, type_name: str) -> dict[str, Any]:
    """For programs.

    Args:
        finding: of sensors of one type.
        structure: of the skin.
        type_name: of the sensors.
    """
    return {
        "kind": finding.kind,
        "modules": [structure.module_names[number] for number in finding.modules],
        "patches": [structure.patch_names[number] for number in finding.patches],
        "uid": structure.sensor_uid[_sensors(finding, structure, type_name)].tolist(),
        "off_m": finding.off_m,
        "degrees": finding.degrees,
    }


def finding_text(finding: Finding, structure: Structure, type_name: str) -> str:
    """One line for people; arguments as of :func:`finding_data`."""
    told = finding_data(finding, structure, type_name)
    names = told["modules"] or told["patches"]
    count, whose = plural(len(finding.taxels), "sensor"), ", ".join(names)
    sensor = structure.sensor_name(int(_sensors(finding, structure, type_name)[0]))
    text = {
        SHARED: f"{count} of {whose} at places of others",
        UNKNOWN: f"{count} of {whose} without a place",
        SWAPPED: f"{' and '.join(names)} are at each other's places: exchanged connectors?",
        MIRRORED: f"{whose}: its mirror image would fit",
        TURNED: f"{whose}: turned by {finding.degrees:.0f} degrees it would fit",
        OFF: f"{sensor} is {1e3 * finding.off_m:.0f} mm from where its neighbours are",
    }[finding.kind]
    return f"{finding.kind}: {text}"


def _sensors(finding: Finding, structure: Structure, type_name: str) -> npt.NDArray[np.int64]:
    """(k,) positions in a frame of the sensors that are meant."""
    sensors: npt.NDArray[np.int64] = np.arange(structure.n_sensors)[structure.index(type_name)][finding.taxels]
    return sensors
