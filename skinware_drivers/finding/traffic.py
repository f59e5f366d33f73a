"""What is heard on a CAN bus: how much of what."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch
from skinware_drivers.link import Heard

_MOST_KEPT = 1 << 17
_CLASS_BITS = 8


@dataclass(frozen=True)
class IdentifierClass:
    """Identifiers that begin alike.

    Attributes:
        name: ``4xx``: 11-bit identifiers 400 to 4FF; ``29-bit``: all of those.
        first: lowest one that was heard.
        last: highest one that was heard.
        identifiers: how many different ones.
        frames: how many frames.
    """

    name: str
    first: int
    last: int
    identifiers: int
    frames: int


class Traffic:
    """Frames as they come; give :meth:`take` to whoever reads the bus.

    Attributes:
        frames: how many there were.
    """

    def __init__(self) -> None:
        self.frames: int = 0
        self._kept = 0
        self._wire: list[npt.NDArray[Any]] = []

    def take(self, batch: FrameBatch) -> None:
        wire = batch.wire[batch.start : batch.stop]
        self.frames += len(wire)
        if self._kept < _MOST_KEPT:
            self._wire.append(wire.copy())
            self._kept += len(wire)

    def wire(self) -> npt.NDArray[Any]:
        """(n,) rows of ``wire_dtype``: the frames, the first 131072 or so of very many."""
        return np.concatenate(self._wire) if self._wire else FrameBatch(0).wire

    def classes(self) -> list[IdentifierClass]:
        identifier = self.wire()["identifier"]
        extended = (identifier & EXTENDED_FLAG) != 0
        number = np.where(extended, 1 << 11 - _CLASS_BITS, identifier >> _CLASS_BITS)
        found = []
        for one in np.unique(number).tolist():
            of_class, counts = np.unique(identifier[number == one] & ~np.uint32(EXTENDED_FLAG), return_counts=True)
            name = "29-bit" if one == 1 << 11 - _CLASS_BITS else f"{one:X}xx"
            found.append(IdentifierClass(name, int(of_class[0]), int(of_class[-1]), len(of_class), int(counts.sum())))
        return found

    def heard(self) -> dict[Heard, int]:
        """What drivers tell frames apart by when they listen, and how often it was heard."""
        wire = self.wire()
        rows = zip(wire["identifier"].tolist(), wire["payload"][:, 0].tolist(), wire["length"].tolist(), strict=True)
        counts: dict[Heard, int] = {}
        for row in rows:
            counts[Heard(*row)] = counts.get(Heard(*row), 0) + 1
        return counts
