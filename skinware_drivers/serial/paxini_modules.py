"""Describe the modules of Paxini's PX-6AX GEN3, and what its boards have in common."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from skinware.geometry import Geometry
from skinware.sensor_types import FORCE_X, FORCE_Y, FORCE_Z, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.hand import FINGERS, Grid, Hand
from skinware_drivers.layout import Layout, Sentinel, Values
from skinware_drivers.link import Link
from skinware_drivers.polling import Notice, Poll
from skinware_drivers.serial.framing import Framing

TAXEL = 3
"""Bytes of a taxel."""
MOST_POINTS = 255
"""Taxels of a module that are believed; the largest known one has 239."""

_PAXINI = 0x5058
"""Number of the vendor in the ids of its own types."""


def _shear(sensor_type: SensorType) -> SensorType:
    return sensor_type.measured(scale=0.1, minimum=-12.8, maximum=12.7)


def _normal(sensor_type: SensorType) -> SensorType:
    return sensor_type.measured(scale=0.1, minimum=0.0, maximum=25.5)


_TAXEL_TYPES = (_shear(FORCE_X), _shear(FORCE_Y), _normal(FORCE_Z))
_RESULTANT_TYPES = (
    _shear(SensorType("resultant_x", _PAXINI << 12 | 1, "N")),
    _shear(SensorType("resultant_y", _PAXINI << 12 | 2, "N")),
    _normal(SensorType("resultant_z", _PAXINI << 12 | 3, "N")),
)
TYPES: Sequence[SensorType] = (*_TAXEL_TYPES, *_RESULTANT_TYPES)
SATURATED: Sequence[Sentinel] = (Sentinel(Status.OUT_OF_RANGE, -128), Sentinel(Status.OUT_OF_RANGE, 255))
"""The ends of ranges, but for 127 within the skin, which along the normal is in the middle."""

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
"""Taxels of a module by its part code."""
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
"""Models by their number of taxels: no two have the same."""

_UID_OF_MODULE = 16
_PLACES = ("near", "middle", "tip", "nail")
_FROM_THE_END = ("nail", "tip", "middle", "near")
_PALMS = 8


def model_of(points: int) -> str:
    """Name of the model that has so many taxels; of one that is not known, their number."""
    return _MODELS.get(points, f"{points} taxels")


def module(number: int, points: int, *, key: int = 0, name: str = "") -> Module:
    """A module with its taxels, each of three axes, and its resultant.

    Args:
        number: of the module on its bus; the uids of its taxels are ``number << 16`` and the next ones.
        points: how many taxels it has.
        key: by which frames name it.
        name: for people.
    """
    first_uid = number << _UID_OF_MODULE
    of_taxels = taxels(points, *(t.name for t in _TAXEL_TYPES), first_uid=first_uid)
    resultant = taxels(1, *(t.name for t in _RESULTANT_TYPES), first_uid=first_uid)
    return Module(of_taxels + resultant, key, model_of(points), name)


def values(points: int, taxels_at: int, resultant_at: int, step: int) -> list[Values]:
    """Where the values of a module are in a payload.

    Args:
        points: how many taxels it has.
        taxels_at: first byte of them.
        resultant_at: first byte of the resultant.
        step: bytes from one of its axes to the next, of which the first counts.
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
    """A place of a high-speed board at which a module is connected.

    Attributes:
        number: of the slot: 0 to 19 on fingers, 20 to 27 on the palm.
        points: taxels of the module that the board tells of.
    """

    number: int
    points: int

    @property
    def part(self) -> str:
        """Of the hand: a finger, or ``palm``."""
        return FINGERS[self.number // len(_PLACES)] if self.is_on_finger else "palm"

    @property
    def is_on_finger(self) -> bool:
        return self.number < len(FINGERS) * len(_PLACES)

    @property
    def place(self) -> str:
        if self.is_on_finger:
            return _PLACES[self.number % len(_PLACES)]
        return str(self.number - len(FINGERS) * len(_PLACES) + 1)

    @property
    def name(self) -> str:
        """For people: ``index tip``, ``palm 3``."""
        return f"{self.part} {self.place}"


def nominal_places(slots: Sequence[Slot], hand: Hand) -> Geometry | None:
    """Where the modules of a hand are, about, with the taxels of each in a compact block; None: no taxels.

    No public map tells how the taxels of all models lie: a block shows which module a taxel is of, not where on it.
    """
    found = []
    for part in (*FINGERS, "palm"):
        here = sorted((slot for slot in slots if slot.part == part and slot.points), key=_from_the_end)
        blocks = [_block(slot.points) for slot in here]
        for slot, block, centre in zip(here, blocks, hand.down(part, blocks), strict=True):
            first_uid = slot.number << _UID_OF_MODULE
            uid = range(first_uid, first_uid + slot.points)
            found.append(block.at(centre, [t.name for t in _TAXEL_TYPES], uid))
    return Geometry.joined(found) if found else None


def _from_the_end(slot: Slot) -> int:
    return _FROM_THE_END.index(slot.place) if slot.is_on_finger else slot.number


def _block(points: int) -> Grid:
    columns = math.isqrt(points - 1) + 1
    return Grid(-(-points // columns), columns)


class Board(ABC):
    """One board on a line; the methods are those of a driver, see :class:`skinware_drivers.adapter.Adapter`.

    Attributes:
        framing: what it sends, as far as it is known yet.
        layout: what its frames mean; known once it was described.
        geometry: where its modules are, about; None: nobody knows.
        period_s: time between two updates.

    Args:
        period_s: time between two updates, as far as it is known yet.
        use: called with a framing: from now on it is that; what was received and is no whole frame is dropped.
        tell: called with what a patch says of itself.
    """

    framing: Framing
    layout: Layout
    geometry: Geometry | None = None

    def __init__(self, period_s: float, use: Callable[[Framing], None], tell: Callable[[Patch, Notice], None]) -> None:
        self.period_s = period_s
        self.use = use
        self.tell = tell

    @property
    def polls(self) -> Sequence[Poll]:
        """What it has to be asked; nothing if it sends by itself."""
        return ()

    @abstractmethod
    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask it what it has."""

    async def start(self, link: Link) -> None:  # noqa: B027  (one that is asked has nothing to do)
        """Have it send by itself, if it can."""

    async def stop(self, link: Link) -> None:  # noqa: B027
        """Make it silent."""

    @abstractmethod
    async def probe(self, link: Link, patch: Patch) -> bool:
        """Whether a silent patch answers, and is what it was."""

    @abstractmethod
    async def attend(self, link: Link) -> None:
        """Hear what is no data."""

    @abstractmethod
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:
        """Take the present forces as zero."""
