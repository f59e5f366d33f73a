"""What is known of the health of taxels: what each may be called, and the evidence."""

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
    """What is known of a taxel; of several things the highest."""

    GOOD = 0
    """Nothing is wrong, as far as anybody can tell."""
    NEVER_TOUCHED = 1
    """Nor can anybody: nothing has touched it yet."""
    WEAK = 2
    """It shows far less of its touches than its neighbours show of theirs."""
    DEAD = 3
    """It shows nothing of what presses both sides of it."""
    NOISY = 4
    """It rustles far more than the typical taxel."""
    STUCK = 5
    """Its value does not change, whatever happens around it."""
    CLIPPED = 6
    """It is at an end of the range, untouched: there is no room left for a touch, or for its drift."""


@dataclass(frozen=True, eq=False)
class HealthReport:
    """What is known of n taxels, and why. NaN: not known (yet).

    Attributes:
        kind: (n,) uint8, :class:`HealthKind`.
        value: (n,) float32, the newest, in the unit of the type.
        still_s: (n,) float32, for how long it has not changed, s.
        peak: (n,) float32, the most that a touch showed, in the unit of the type.
        noise: (n,) float32, standard deviation, in the unit of the type.
        noise_times: (n,) float32, the same in those of the typical taxel.
        clipped: (n,) float32, share of the time at an end of the range.
        touches: (n,) uint32, separate touches of both its sides.
        shown: (n,) float32, what it showed of its due in them.
        shown_around: (n,) float32, what its neighbours did; only where that is much more.
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

    @classmethod
    def unknown(cls, n: int) -> Self:
        """Of n taxels of which nothing is known."""
        return cls(**{name: np.full(n, nothing, dtype) for name, (dtype, nothing) in COLUMNS.items()})

    @property
    def faulty(self) -> Flags:
        """(n,) bool: which taxels have a fault."""
        faulty: Flags = self.kind > HealthKind.NEVER_TOUCHED
        return faulty

    def evidence(self, taxel: int, unit: str = "") -> str:
        """Why a taxel is called what it is, in words.

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
        share = f"shows {100 * max(of['shown'], 0):.0f} % of what presses both its sides, in {of['touches']} touches"
        if kind is HealthKind.WEAK:
            return f"{share}; its neighbours show {100 * of['shown_around']:.0f} %"
        return share if kind is HealthKind.DEAD else ""


COLUMNS: dict[str, tuple[str, float]] = {
    "kind": ("u1", 0),
    **dict.fromkeys(("value", "still_s", "peak", "noise", "noise_times", "clipped"), ("<f4", math.nan)),
    "touches": ("<u4", 0),
    **dict.fromkeys(("shown", "shown_around"), ("<f4", math.nan)),
}
"""Arrays of a :class:`HealthReport`: dtype of each, and what stands there if nothing is known."""
