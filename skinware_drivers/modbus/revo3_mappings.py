"""The registers of BrainCo's Revo3 hand in the three forms that its maker's programs read, and where its taxels are.

Sources:

* BrainCoTech/brainco-revo3-sdk, commit 7ba96eb of 2026-08-03: ``docs/device/REVO3_TOUCH_API.md`` (registers of the
  mappings Pressure and Matrix) and ``python/gui/touch_panel_revo3.py`` (counts, units, rows and columns of the pads).
* The maker's programs bc-revo3-sdk 1.5.1, 1.6.3 and 2.3.2 (PyPI) as clients of a server whose registers hold their own
  numbers, on 2026-11-23: what 101 and 135 say, the counts in 4037 to 4047, and the form ``packed``, which 1.6.3 and
  2.3.2 read where 1.5.1 reads ``matrix``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from skinware.sensor_types import FORCE_Z, PRESSURE, SensorType
from skinware_drivers.hand import FINGERS, Grid

PADS = ("palm", *(f"{finger} {part}" for finger in FINGERS for part in ("tip", "pad")))
SIDE_AT, RIGHT = 101, 1
FAMILY_AT, PRESSURE_FAMILY, MATRIX_FAMILY = 135, 1, 2
KIND_AT, VALUE_AT, PRESSURE_COUNTS_AT, SUMS_AT = 4023, 4024, 4037, 4100
MATRIX_COUNTS_AT, MODE_AT, MODES_AT = 5191, 5202, 5203
COUNTS_OF_SUMS: tuple[int, ...] = (1, 3, 6, *(3, 5) * 4)
"""Zones of each pad of which a hand of the mapping Pressure can send sums."""

_COUNTS = PRESSURE.measured(unit="counts", minimum=0)
_BYTES = PRESSURE.measured(unit="counts", minimum=0, maximum=0xFF)
_FORCE_COUNTS = FORCE_Z.measured(unit="counts", minimum=0)


@dataclass(frozen=True)
class Mapping:
    """Where things are in one form.

    Attributes:
        pads: first register of each pad, and the one after the last pad.
        counts: taxels of each pad, where the hand does not say it.
        switches: first of the eleven registers that switch pads on.
        zero: the register that takes the present values as zero.
        in_register: values in a register, the first in its high byte if there are two.
        types: of values by the mode that the hand says: 0, 1 ...
    """

    pads: Sequence[int]
    counts: Sequence[int]
    switches: int
    zero: int
    in_register: int
    types: Sequence[SensorType]

    def count_fits(self, pad: int, count: int) -> bool:
        return 1 <= count <= self.in_register * (self.pads[pad + 1] - self.pads[pad])


_MATRIX_COUNTS = (53, 56, 22, *(22, 27) * 4)
MAPPINGS = {
    "pressure": Mapping(
        (4200, 4250, 4290, 4350, 4400, 4460, 4500, 4560, 4600, 4660, 4700, 4752),
        (36, 31, 57, *(21, 52) * 4),
        switches=4000,
        zero=4011,
        in_register=1,
        types=(_COUNTS, _COUNTS, _FORCE_COUNTS),
    ),
    "matrix": Mapping(
        range(5240, 5901, 60),
        _MATRIX_COUNTS,
        switches=5900,
        zero=5214,
        in_register=1,
        types=(_COUNTS, FORCE_Z.measured(scale=1e-4, minimum=0)),
    ),
    "packed": Mapping(
        (5240, *(first + more for first in range(5340, 5841, 100) for more in (0, 40)))[:12],
        _MATRIX_COUNTS,
        switches=5900,
        zero=5214,
        in_register=2,
        types=(_BYTES, FORCE_Z.measured(scale=1e-2, minimum=0, maximum=2.55)),
    ),
}
SUM = FORCE_Z.measured(scale=1e-3, minimum=0)

_TIP = "123 123 1234 1234 1234 5 5 5"
_PAD = "15 1234 1234 01234" + 5 * " 12345" + 4 * " 567"
_COLUMNS = {
    "right palm": "12345 012345 012345 0345 0345 0345 035 045 5",
    "left palm": "01234 012345 012345 0125 0125 0125 025 015 0",
    "thumb tip": "0134 01345 012345 012345 012345 6 6 6 6",
    "thumb pad": 8 * "01234 " + "123 12" + 4 * " 567",
}
"""Row by row, the columns in which a pad of the mapping Pressure has taxels, in their order."""
_MATRIX_COLUMNS = 6


def places(mapping: str, side: str, pad: int, count: int) -> tuple[Grid, Sequence[int]]:
    """The grid of a pad and the cells of its taxels; where the maker gives no table, they fill the grid in order."""
    name = PADS[pad]
    rows = _COLUMNS.get(f"{side} {name}", _COLUMNS.get(name, _TIP if name.endswith("tip") else _PAD)).split()
    if mapping != "pressure" or sum(map(len, rows)) != count:
        return Grid(-(-count // _MATRIX_COLUMNS), _MATRIX_COLUMNS), range(count)
    columns = 1 + max(int(column) for row in rows for column in row)
    return Grid(len(rows), columns), [columns * number + int(one) for number, row in enumerate(rows) for one in row]
