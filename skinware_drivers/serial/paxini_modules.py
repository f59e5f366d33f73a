"""The modules of Paxini's PX-6AX GEN3."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skinware.geometry import Geometry
from skinware.nominal_hand import FINGERS
from skinware.sensor_types import FORCE_X, FORCE_Y, FORCE_Z, SensorType
from skinware.status import Status
from skinware_drivers import Module, Sentinel, Values, taxels
from skinware_drivers.hand import PITCH_M, Grid, Hand

TAXEL = 3
"""Bytes of a taxel."""
MOST_POINTS = 255
"""Taxels of a module that are believed; the largest known one has 239."""

_PAXINI = 0x5058
"""Number of the vendor in the ids of its own types."""
_RANGES_N = ((-12.8, 12.7), (-12.8, 12.7), (0.0, 25.5))
"""Ranges of the axes x, y (within the skin) and z (along the normal); a byte each, in 0.1 N."""
_TAXEL_TYPES, _RESULTANT_TYPES = (
    tuple(
        axis.measured(scale=0.1, minimum=low, maximum=high) for axis, (low, high) in zip(axes, _RANGES_N, strict=True)
    )
    for axes in (
        (FORCE_X, FORCE_Y, FORCE_Z),
        [SensorType(f"resultant_{axis}", _PAXINI << 12 | n, "N") for n, axis in enumerate("xyz", 1)],
    )
)
TYPES: Sequence[SensorType] = (*_TAXEL_TYPES, *_RESULTANT_TYPES)
SATURATED: Sequence[Sentinel] = (Sentinel(Status.OUT_OF_RANGE, -128), Sentinel(Status.OUT_OF_RANGE, 255))
"""The ends of the ranges, except 127 within the skin, which is an ordinary value along the normal."""

POINTS_OF_PART: Mapping[str, int] = {
    "PXSR-STDCP03A": 239,
    "PXSR-STDCP03B": 77,
    "PXSR-STDDP03A": 135,
    "PXSR-STDDP03B": 127,
    "PXSR-STDDP03C": 116,
    "PXSR-STDDP03D": 51,
    "PXSR-STDDP03E": 96,
    "PXSR-STDDP03F": 31,
    "PXSR-STDDP03G": 52,
    "PXSR-STDIP03A": 68,
    "PXSR-STDIP03B": 25,
    "PXSR-STDMC03A": 9,
}
"""Number of taxels of a module by its part code."""
_MODELS: Mapping[int, str] = {
    9: "M2020",
    25: "S1610",
    31: "S1813-Elite",
    51: "S1813-Core",
    52: "S2015",
    68: "M2324",
    77: "M3025",
    96: "S3013",
    116: "S2716",
    127: "M2826",
    135: "L3530",
    239: "L5325",
}
"""Models by their number of taxels, which differs for all models."""

_UID_OF_MODULE = 16
_WIDEST_MM = 18
_IN_A_ROW = 4
_PALM = Grid(8, 4 * _IN_A_ROW, 0.0034)
_PLACES = ("near", "middle", "tip", "nail")
_FROM_THE_END = ("nail", "tip", "middle", "near")


def model_of(points: int) -> str:
    return _MODELS.get(points, f"{points} taxels")


def module(number: int, points: int, *, key: int = 0, name: str = "") -> Module:
    """Return a module with its taxels, each of three axes, and its resultant; uids begin with ``number << 16``."""
    first_uid = number << _UID_OF_MODULE
    of_taxels = taxels(points, *(t.name for t in _TAXEL_TYPES), first_uid=first_uid)
    resultant = taxels(1, *(t.name for t in _RESULTANT_TYPES), first_uid=first_uid)
    return Module(of_taxels + resultant, key, model_of(points), name)


def values(points: int, taxels_at: int, resultant_at: int, step: int) -> list[Values]:
    """Return the places of a module's values in a payload.

    The axes of the resultant are ``step`` bytes apart, of which the first counts.
    """
    n = TAXEL * points
    found = [
        Values(resultant_at + axis * step, dtype, 1, to=(n + axis,)) for axis, dtype in enumerate(("i1", "i1", "u1"))
    ]
    if points:
        shear = tuple(None if channel % TAXEL == 2 else channel for channel in range(n))
        normal = tuple(channel if channel % TAXEL == 2 else None for channel in range(n))
        found += [Values(taxels_at, "i1", n, to=shear), Values(taxels_at, "u1", n, to=normal)]
    return found


@dataclass(frozen=True)
class Slot:
    """A place of a high-speed board with a module of so many taxels: 0 to 19 on fingers, 20 to 27 on the palm."""

    number: int
    points: int

    @property
    def part(self) -> str:
        """The part of the hand: a finger, or ``palm``."""
        return FINGERS[self.number // len(_PLACES)] if self.is_on_finger else "palm"

    @property
    def is_on_finger(self) -> bool:
        return self.number < len(FINGERS) * len(_PLACES)

    @property
    def place(self) -> str:
        if self.is_on_finger:
            return _PLACES[self.number % len(_PLACES)]
        return str(self.number - len(FINGERS) * len(_PLACES) + 1)

    def uid(self, point: int) -> int:
        return (self.number << _UID_OF_MODULE) + point

    @property
    def name(self) -> str:
        """For people: ``index tip``, ``palm 3``."""
        return f"{self.part} {self.place}"


def nominal_places(slots: Sequence[Slot], hand: Hand) -> Geometry | None:
    """Return nominal places of the modules of a hand, the taxels of each in a block; None: no taxels.

    No map of the taxels of all models is public: a block shows on which module a taxel is, not where on it. The palm's
    modules are in rows of four.
    """
    found, names = [], [t.name for t in _TAXEL_TYPES]
    for part in FINGERS:
        here = [slot for slot in slots if slot.part == part and slot.points]
        here.sort(key=lambda slot: _FROM_THE_END.index(slot.place))
        blocks = [_block(slot.points) for slot in here]
        for slot, block, place in zip(here, blocks, hand.down(part, blocks), strict=True):
            found.append(block.at(place, names, [slot.uid(point) for point in range(slot.points)]))
    [place] = hand.down("palm", [_PALM])
    for slot in slots:
        if not slot.is_on_finger and slot.points:
            row, column = divmod(int(slot.place) - 1, _IN_A_ROW)
            points = [divmod(point, 3) for point in range(slot.points)]
            cells = [(4 * row + down) * _PALM.columns + 4 * column + across for down, across in points]
            found.append(_PALM.at(place, names, [slot.uid(point) for point in range(slot.points)], cells))
    return Geometry.joined(found) if found else None


def _block(points: int) -> Grid:
    """Return a grid of the size in the model's name, if its digits are mm, but no wider than a finger."""
    digits = re.search(r"(\d\d)(\d\d)", _MODELS.get(points, ""))
    length, width = map(int, digits.groups()) if digits else (1, 1)
    columns = max(1, round(math.sqrt(points * width / length)))
    return Grid(-(-points // columns), columns, min(width, _WIDEST_MM) / columns / 1e3 if digits else PITCH_M)
