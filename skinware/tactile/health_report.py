"""Describe the health of taxels: the kinds of faults, and reports with the evidence."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class HealthKind(enum.IntEnum):
    """The judgement of a taxel."""

    GOOD = 0
    """Nothing is known to be wrong."""
    NEVER_TOUCHED = 1
    """Nothing has touched it yet, so nothing is known."""
    WEAK = 2
    """It shows far less of its touches than its neighbours show of theirs."""
    DEAD = 3
    """It shows nothing when both its sides are pressed."""
    NOISY = 4
    """Its noise is far above that of the typical taxel."""
    STUCK = 5
    """Its value does not change, whatever happens around it."""
    CLIPPED = 6
    """It is at an end of the range, untouched: there is no room left for a touch, or for its drift."""
    INTERMITTENT = 7
    """It works now and then: it misses touches and feels others, or falls from its baseline by itself."""
    DYING = 8
    """Its share of its touches falls and falls."""
    SWAPPED = 9
    """It shows what presses its partner's place, and not what presses its own."""
    SHORTED = 10
    """It and its partner move as one."""
    CROSSTALK = 11
    """It shows a part of what presses its partner, beside what presses itself."""


@dataclass(frozen=True, eq=False)
class HealthReport:
    """The health of n taxels, with the evidence. NaN: not known (yet).

    Attributes:
        kind: (n,) uint8, :class:`HealthKind`.
        value: (n,) float32, the newest, in the unit of the type.
        still_s: (n,) float32, for how long it has not changed, s.
        peak: (n,) float32, the most that a touch showed, in the unit of the type.
        noise: (n,) float32, standard deviation, in the unit of the type.
        noise_times: (n,) float32, the same in multiples of the typical taxel's.
        clipped: (n,) float32, share of the time at an end of the range.
        touches: (n,) uint32, separate touches of both its sides.
        shown: (n,) float32, the share of its due that it showed in them.
        shown_around: (n,) float32, the share that its neighbours showed; only where that is much more.
        returns: (n,) float32, how often it felt a touch again after it had missed some; older ones count less.
        falls: (n,) float32, how often it fell far below its baseline by itself; older ones count less.
        lost: (n,) float32, the part of its share that it lost since the touches began to count.
        partner: (n,) int32, the taxel that it is confused with; -1: none.
        echo: (n,) float32, the share of the load at its partner that it shows.
    """

    kind: npt.NDArray[np.uint8]
    value: Floats
    still_s: Floats
    peak: Floats
    noise: Floats
    noise_times: Floats
    clipped: Floats
    touches: npt.NDArray[np.uint32]
    shown: Floats
    shown_around: Floats
    returns: Floats
    falls: Floats
    lost: Floats
    partner: npt.NDArray[np.int32]
    echo: Floats

    @classmethod
    def unknown(cls, n: int) -> Self:
        """Make a report of n taxels about which nothing is known."""
        return cls(**{name: np.full(n, nothing, dtype) for name, (dtype, nothing) in COLUMNS.items()})

    @property
    def faulty(self) -> Flags:
        """(n,) bool: which taxels have a fault."""
        faulty: Flags = self.kind > HealthKind.NEVER_TOUCHED
        return faulty

    def evidence(self, taxel: int, unit: str = "") -> str:
        """Return the reason for the kind of a taxel, in words.

        Args:
            taxel: which of the n.
            unit: of the values.
        """
        kind = HealthKind(self.kind[taxel])
        of = {field.name: getattr(self, field.name)[taxel].item() for field in fields(self)}
        value = f"{of['value']:.4g} {unit}".strip()
        if kind is HealthKind.CLIPPED:
            return f"at {value}, an end of the range, for {100 * of['clipped']:.0f} % of the time"
        if kind is HealthKind.STUCK:
            return f"at {value} for {of['still_s']:.0f} s, while its module was touched"
        if kind is HealthKind.NOISY:
            noise = f"noise {of['noise']:.3g} {unit}".strip()
            return f"{noise}, {of['noise_times']:.1f} times that of the others"
        if kind is HealthKind.INTERMITTENT:
            return f"missed touches and felt others {of['returns']:.0f} times, fell by itself {of['falls']:.0f} times"
        if kind is HealthKind.DYING:
            return f"lost {100 * of['lost']:.0f} % of its share of touches"
        if kind is HealthKind.SHORTED:
            return f"moves as one with sensor {of['partner']}"
        if kind in (HealthKind.SWAPPED, HealthKind.CROSSTALK):
            return f"shows {100 * of['echo']:.0f} % of what presses sensor {of['partner']}"
        share = f"shows {100 * max(of['shown'], 0):.0f} % of what presses both its sides, in {of['touches']} touches"
        if kind is HealthKind.WEAK:
            return f"{share}; its neighbours show {100 * of['shown_around']:.0f} %"
        return share if kind is HealthKind.DEAD else ""


COLUMNS: dict[str, tuple[str, float]] = {
    "kind": ("u1", 0),
    **dict.fromkeys(("value", "still_s", "peak", "noise", "noise_times", "clipped"), ("<f4", math.nan)),
    "touches": ("<u4", 0),
    **dict.fromkeys(("shown", "shown_around", "returns", "falls", "lost"), ("<f4", math.nan)),
    "partner": ("<i4", -1),
    "echo": ("<f4", math.nan),
}
"""Arrays of a :class:`HealthReport`: dtype of each, and its value where nothing is known."""
