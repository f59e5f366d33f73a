"""Report the health of taxels: the kind of each, with the evidence."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import numpy.typing as npt

from skinware.tactile.arrays import Bytes, Columns, Flags, Floats


class HealthKind(enum.IntEnum):
    """The judgement of a taxel; where several apply, the highest."""

    GOOD = 0
    """Nothing is known to be wrong."""
    NEVER_TOUCHED = 1
    """Nothing has touched it yet, so nothing is known."""
    WEAK = 2
    """It shows far less of its touches than its neighbours show of theirs."""
    DYING = 3
    """It shows far less of its touches than it did before."""
    DEAD = 4
    """It shows nothing when both its sides are pressed."""
    CROSSTALK = 5
    """It shows a part of the touches of another taxel of its module."""
    NOISY = 6
    """Its noise is far above that of the typical taxel."""
    INTERMITTENT = 7
    """It loses its value again and again for a moment, while its neighbours keep theirs."""
    SWAPPED = 8
    """It shows what presses the place of another taxel: their wires or uids are exchanged."""
    SHORTED = 9
    """It shows the same as another taxel."""
    STUCK = 10
    """Its value does not change, whatever happens around it."""
    CLIPPED = 11
    """It is at an end of the range, untouched: there is no room left for a touch, or for its drift."""


@dataclass(frozen=True, eq=False)
class HealthReport:
    """The health of n taxels, with the evidence: arrays (n,), whose meaning is in :data:`COLUMNS`.

    NaN: not known (yet). ``other`` is the number of a taxel among the n.
    """

    kind: Bytes
    value: Floats
    still_s: Floats
    peak: Floats
    noise: Floats
    noise_times: Floats
    clipped: Floats
    touches: npt.NDArray[np.uint32]
    shown: Floats
    shown_around: Floats
    recent: Floats
    best: Floats
    dropouts: Floats
    other: npt.NDArray[np.int32]
    other_shown: Floats

    @classmethod
    def unknown(cls, n: int) -> Self:
        """Make a report of n taxels about which nothing is known."""
        return cls(**{name: np.full(n, NOTHING[name], dtype) for name, (dtype, *_) in COLUMNS.items()})

    @property
    def faulty(self) -> Flags:
        """(n,) bool: which taxels have a fault."""
        faulty: Flags = self.kind > HealthKind.NEVER_TOUCHED
        return faulty

    def evidence(self, taxel: int, unit: str = "", other: str = "") -> str:
        """Return the reason for the kind of a taxel, in words.

        Args:
            taxel: which of the n.
            unit: of the values.
            other: name of the taxel whose touches it shows; default: its number.
        """
        kind = HealthKind(self.kind[taxel])
        of = {field.name: getattr(self, field.name)[taxel].item() for field in fields(self)}
        other = other or f"taxel {of['other']}"
        value = f"{of['value']:.4g} {unit}".strip()
        if kind is HealthKind.CLIPPED:
            return f"at {value}, an end of the range, for {100 * of['clipped']:.0f} % of the time"
        if kind is HealthKind.STUCK:
            return f"at {value} for {of['still_s']:.0f} s, while its module was touched"
        if kind is HealthKind.NOISY:
            noise = f"noise {of['noise']:.3g} {unit}".strip()
            return f"{noise}, {of['noise_times']:.1f} times that of the others"
        if kind is HealthKind.INTERMITTENT:
            return f"lost its value about {of['dropouts']:.0f} times in ten minutes, while its neighbours kept theirs"
        if kind is HealthKind.SWAPPED:
            return f"shows what presses {other}"
        if kind in (HealthKind.CROSSTALK, HealthKind.SHORTED):
            return f"shows {100 * of['other_shown']:.0f} % of what presses {other}"
        share = f"shows {100 * max(of['shown'], 0):.0f} % of what presses both its sides, in {of['touches']} touches"
        if kind is HealthKind.WEAK:
            return f"{share}; its neighbours show {100 * of['shown_around']:.0f} %"
        if kind is HealthKind.DYING:
            return (
                f"shows {100 * of['recent']:.0f} % of what presses both its sides; it showed {100 * of['best']:.0f} %"
            )
        return share if kind is HealthKind.DEAD else ""


COLUMNS: Columns = {
    "kind": ("u1", (), "", ", ".join(f"{kind:d}: {kind.name.lower().replace('_', ' ')}" for kind in HealthKind)),
    "value": ("<f4", (), "", "the newest, in the unit of the type"),
    "still_s": ("<f4", (), "s", "for how long it has not changed"),
    "peak": ("<f4", (), "", "the most that a touch showed, in the unit of the type"),
    "noise": ("<f4", (), "", "standard deviation, in the unit of the type"),
    "noise_times": ("<f4", (), "", "the same in multiples of the typical sensor's"),
    "clipped": ("<f4", (), "", "share of the time at an end of the range"),
    "touches": ("<u4", (), "", "separate touches of both its sides"),
    "shown": ("<f4", (), "", "share of its due that it showed in them"),
    "shown_around": ("<f4", (), "", "share that its neighbours showed; only where that is much more"),
    "recent": ("<f4", (), "", "mean share of its last 20 touches"),
    "best": ("<f4", (), "", "largest of these means so far"),
    "dropouts": ("<f4", (), "", "how often it lost its value; half of it is forgotten in ten minutes"),
    "other": ("<i4", (), "", "position of the sensor whose touches it shows; -1: none"),
    "other_shown": ("<f4", (), "", "part of them that it shows"),
}
"""Dtype, shape, unit and meaning, per taxel, of each array of a :class:`HealthReport`."""
NOTHING: dict[str, float] = {name: math.nan if dtype == "<f4" else 0 for name, (dtype, *_) in COLUMNS.items()} | {
    "dropouts": 0,
    "other": -1,
}
"""The value in each array where nothing is known."""
