"""The drivers that are tested alike, each with its emulator."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from skinware_drivers.can.barrett import BarrettDriver
from skinware_drivers.can.canopen_patch import CanopenDriver
from skinware_drivers.can.cyskin_cpm import CyskinCpmDriver
from skinware_drivers.can.xela import XelaDriver
from skinware_drivers.serial.openpatch import OpenPatchDriver
from skinware_drivers.virtual.barrett import EmulatedBarrett
from skinware_drivers.virtual.canopen_patch import EmulatedCanopen
from skinware_drivers.virtual.cyskin_cpm import EmulatedCyskinCpm
from skinware_drivers.virtual.openpatch import EmulatedOpenPatch
from skinware_drivers.virtual.xela import EmulatedXela
from tests.drivers.bench import Case


def ten_strongest(values: Sequence[int]) -> list[int]:
    """In N/cm2; of equals, the first."""
    weakest_last = sorted((-value, cell) for cell, value in enumerate(values))
    listed = {cell for _, cell in weakest_last[:10]}
    return [value // 256 if cell in listed else 0 for cell, value in enumerate(values)]


def with_temperature(values: Sequence[int]) -> list[int]:
    """The example patch also sends that it has 25.0 degrees."""
    return [*values, 250]


CASES = [
    pytest.param(Case(CanopenDriver, EmulatedCanopen, {"nodes": (5, 6)}, shown=with_temperature), id="canopen"),
    pytest.param(Case(XelaDriver, EmulatedXela), id="xela"),
    pytest.param(
        Case(
            XelaDriver,
            EmulatedXela,
            {"boards": (1, 3), "ids": "row_column", "first_id": (0x100, 0x200), "columns": 6},
            {"boards": (1, 3), "model": "4x6"},
        ),
        id="xela 4x6",
    ),
    pytest.param(Case(CyskinCpmDriver, EmulatedCyskinCpm), id="cyskin_cpm"),
    pytest.param(Case(BarrettDriver, EmulatedBarrett), id="barrett"),
    pytest.param(Case(OpenPatchDriver, EmulatedOpenPatch), id="openpatch"),
    pytest.param(
        Case(
            BarrettDriver, EmulatedBarrett, {"format": "top10", "nodes": (11, 14)}, {"nodes": (11, 14)}, ten_strongest
        ),
        id="barrett top 10",
    ),
]
