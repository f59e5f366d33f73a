"""Rows and columns of matrices of which nothing good comes: one broken wire each, and not so many broken taxels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.matrices import filled_by
from skinware.structure import Structure


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
