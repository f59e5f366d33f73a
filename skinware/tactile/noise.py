"""How much untouched taxels rustle, and how much of the time they stand at an end of their range."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.tactile.calm import Calm

_ENOUGH_FRAMES = 100
"""At least, away from touches, to tell a noise; with fewer its measurement goes on."""
_GROWTH = 1.2
"""So many times a noise may grow from one measurement to the next."""

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


class Noise:
    """Measures n taxels again and again, by the differences from frame to frame.

    What presses nearby makes differences too: the least of some measurements counts. What lets go of a taxel whose
    baseline was taken under it (at the start, or by a tare) makes one as large as its load: the taxel falls far below
    its baseline, which follows it there soon. What the taxel did in between does not count.

    Args:
        n: number of taxels.
        measured_s: how long one measurement takes.

    Attributes:
        deviation: (n,) float32, standard deviation, in the unit of the values; NaN before it is known.
        at_end: (n,) float32, share of the time at an end of the range; NaN before it is known.
    """

    def __init__(self, n: int, measured_s: float) -> None:
        self.deviation: Floats = np.full(n, np.nan, np.float32)
        self.at_end: Floats = np.full(n, np.nan, np.float32)
        self._measured_s = measured_s
        self._begun_s = 0.0
        self._was_free = np.zeros(n, bool)
        self._sums: Floats = np.zeros((3, n), np.float32)
        """Of squared differences, of frames, and of those at an end of the range."""
        self._low = np.zeros(n, bool)
        self._stays_low = np.zeros(n, bool)
        """Low since before the last measurement ended: nothing will follow these."""
        self._before_low: Floats = np.zeros((3, n), np.float32)
        """The sums when each taxel fell."""

    def add(self, now_s: float, difference: Floats, at_end: Flags, low: Flags, calm: Calm) -> bool:
        """Take the next frame in.

        Args:
            now_s: its time.
            difference: (n,) of the values from those of the frame before.
            at_end: (n,) which are at an end of the range.
            low: (n,) which are far below their baselines.
            calm: what the baseline made of the frame.

        Returns:
            Whether a measurement ends with it.
        """
        self._note_low(low, calm)
        free = calm.usable & ~calm.touched
        both = free & self._was_free
        self._was_free = free
        difference = np.where(both, difference, np.float32(0))
        squares, frames, ends = self._sums
        squares += difference * difference
        frames += both
        ends += both & at_end
        if now_s - self._begun_s < self._measured_s:
            return False
        self._begun_s = now_s
        self._conclude()
        return True

    def _note_low(self, low: Flags, calm: Calm) -> None:
        """Follow who is low; forget what those did meanwhile whose baselines have followed them."""
        changed = np.flatnonzero((low != self._low) & calm.usable)
        if not len(changed):
            return
        fell = low[changed]
        fallen, back = changed[fell], changed[~fell]
        followed = back[calm.forced[back]]
        self._before_low[:, fallen] = self._sums[:, fallen]
        self._sums[:, followed] = self._before_low[:, followed]
        self._low[changed] = fell
        self._stays_low[back] = False

    def _conclude(self) -> None:
        """Tell what was measured, and begin anew; for those that fell only now it is what was before that."""
        counted = np.where(self._low & ~self._stays_low, self._before_low, self._sums)
        squares, frames, ends = counted
        enough = frames >= _ENOUGH_FRAMES
        noise = np.sqrt(squares[enough] / (2 * frames[enough]))
        self.deviation[enough] = np.fmin(noise, _GROWTH * self.deviation[enough])
        self.at_end[enough] = ends[enough] / frames[enough]
        self._sums[:, enough] -= counted[:, enough]
        self._before_low[:, enough] = 0
        self._stays_low[:] = self._low
