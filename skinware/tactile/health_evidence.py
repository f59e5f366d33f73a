"""Gather the evidence of taxels' health: their noise, their use, and their drops."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from skinware.tactile.baseline import Calm
from skinware.tactile.neighbours import NONE, Table

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Whole = npt.NDArray[np.int64]

_ENOUGH_FRAMES = 100
"""Frames away from touches that a measurement of noise needs; with fewer it goes on."""
_GROWTH = 1.2
"""Times: a noise grows by at most this from one measurement to the next."""
APART_S = 1.0
"""Seconds: touches of a taxel with less time between them count as one."""
_MODULE_APART_S = 5.0
"""Seconds: the same for a module, of which fingers touch one part after the other."""
KEPT = 0.95
"""Weight that older touches keep with each new one: a mended taxel is good again after some touches."""


_FALLS_S = 1800.0
"""Seconds in which a fall loses its weight e-fold."""
_SETTLED_S = 3.0
"""Seconds after a touch in which the cover moves."""
_SAG_REACHES = 3
"""Neighbours of neighbours of neighbours: so far a press pulls the cover down."""
_MOST_OF_MODULE = 0.25
"""Share of a module: where more of it falls, the board moved its baselines."""


class Noise:
    """Measures the noise of n taxels again and again, by the differences from frame to frame.

    A press nearby makes differences too, so a noise grows slowly. A release makes one as large as its load, if the
    baseline was taken under that load (at the start, or by a tare): the taxel falls far below its baseline, which
    follows it there soon. Differences in between do not count.

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
        self._was_free: Flags = np.zeros(n, bool)
        self._sums: Floats = np.zeros((3, n), np.float32)
        """Sums of squared differences, of frames, and of frames at an end of the range."""
        self._low: Flags = np.zeros(n, bool)
        self._stays_low: Flags = np.zeros(n, bool)
        """Taxels that were low before the last measurement ended: no baseline follows these."""
        self._before_low: Floats = np.zeros((3, n), np.float32)
        """The sums when each taxel fell."""

    def add(self, now_s: float, difference: Floats, at_end: Flags, low: Flags, free: Flags, calm: Calm) -> bool:
        """Take the next frame in.

        Args:
            now_s: its time.
            difference: (n,) of the values from those of the frame before.
            at_end: (n,) which are at an end of the range.
            low: (n,) which are far below their baselines.
            free: (n,) which are neither touched nor far above their baselines, as at the beginning of a touch.
            calm: what the baseline made of the frame.

        Returns:
            Whether a measurement ends with it.
        """
        self._note_low(low, calm)
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
        """Follow which taxels are low; drop the sums of those whose baselines have followed them meanwhile."""
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
        """End a measurement. For taxels that fell only now, it ends before their fall."""
        counted = np.where(self._low & ~self._stays_low, self._before_low, self._sums)
        squares, frames, ends = counted
        enough = frames >= _ENOUGH_FRAMES
        noise = np.sqrt(squares[enough] / (2 * frames[enough]))
        self.deviation[enough] = np.fmin(noise, _GROWTH * self.deviation[enough])
        self.at_end[enough] = ends[enough] / frames[enough]
        self._sums[:, enough] -= counted[:, enough]
        self._before_low[:, enough] = 0
        self._stays_low[:] = self._low


class Use:
    """Follows when n taxels changed, and how hard they and their modules were touched.

    Args:
        module: (n,) int, the module of each taxel.
        touches: touches of a module whose times are kept.

    Attributes:
        seen: (n,) bool, which taxels have ever had a value.
        value: (n,) float32, the newest.
        changed_s: (n,) when it last changed, s.
        usable: (n,) bool, which have a value in the newest frame.
        touched: (n,) bool, in the newest frame.
        touched_s: (n,) when it was last touched, s.
        peak: (n,) float32, the most that a touch showed.
        usual: (n,) float32, the same, less of it with each touch.
        module_touched_s: (n_modules, touches) when each module was last touched, s, the oldest first.
    """

    def __init__(self, module: npt.NDArray[np.intp], touches: int) -> None:
        n = len(module)
        self._module = module
        self.seen: Flags = np.zeros(n, bool)
        self.value: Floats = np.full(n, np.nan, np.float32)
        self.changed_s: npt.NDArray[np.float64] = np.zeros(n)
        self.usable: Flags = np.zeros(n, bool)
        self.touched: Flags = np.zeros(n, bool)
        self.touched_s = np.full(n, -math.inf)
        self.peak: Floats = np.zeros(n, np.float32)
        self.usual: Floats = np.zeros(n, np.float32)
        self.module_touched_s = np.full((int(module.max(initial=-1)) + 1, touches), -math.inf)

    def add(self, now_s: float, passed_s: float, given: Floats, calm: Calm) -> None:
        """Take the next frame in; time without data does not count as time without change."""
        usable = self.usable = calm.usable
        changed = usable & (given != self.value)
        np.copyto(self.changed_s, now_s, where=changed)
        if not usable.all():
            self.changed_s += passed_s * ~usable
        np.copyto(self.value, given, where=changed)
        self.seen |= usable
        touched = calm.touched & usable
        active = np.flatnonzero(touched)
        begun = active[~self.touched[active]]
        self.touched = touched
        self.touched_s[active] = now_s
        self.usual[begun] *= KEPT
        for most in (self.peak, self.usual):
            most[active] = np.maximum(most[active], calm.value[active])
        if len(begun):
            module = np.unique(self._module[begun])
            last = self.module_touched_s[module]
            module, last = (of[now_s - last[:, -1] >= _MODULE_APART_S] for of in (module, last))
            self.module_touched_s[module] = np.column_stack([last[:, 1:], np.full(len(module), now_s)])


class Drops:
    """Counts how often taxels fall far below their baselines by themselves, at once, away from touches.

    A touch nearby is known only some frames after the cover sank, so each fall is looked at a second later.

    Args:
        neighbours: (n, k) the neighbours of each.

    Attributes:
        count: (n,) float64; older ones count less.
    """

    def __init__(self, neighbours: Table) -> None:
        n = len(neighbours)
        self._neighbours = neighbours
        self.count = np.zeros(n)
        self._fell_s, self._counted_s = np.full(n, math.inf), np.zeros(n)

    def add(self, now_s: float, fell: Flags, low: Flags, use: Use, module: npt.NDArray[np.intp]) -> None:
        """Take the next frame in.

        Args:
            now_s: its time.
            fell: (n,) which have fallen since the frame before.
            low: (n,) which are far below their baselines.
            use: their use.
            module: (n,) of each.
        """
        rows = np.flatnonzero(fell & use.usable)
        if len(rows):
            of_module = np.bincount(module, low)[module[rows]] / np.bincount(module)[module[rows]]
            around = self._neighbours[rows]
            known = around != NONE
            alone = known.any(axis=1) & ~(low[around] & known).any(axis=1) & (of_module < _MOST_OF_MODULE)
            self._fell_s[rows[alone & np.isinf(self._fell_s[rows])]] = now_s
        due = np.flatnonzero(self._fell_s < now_s - APART_S)
        if not len(due):
            return
        near = due[:, None]
        for _ in range(_SAG_REACHES):
            near = np.where((near != NONE)[:, :, None], self._neighbours[near], NONE).reshape(len(due), -1)
        touched_s = np.where(near != NONE, use.touched_s[near], -math.inf).max(axis=1, initial=-math.inf)
        quiet = due[touched_s < self._fell_s[due] - _SETTLED_S]
        self.count[quiet] = 1 + self.count[quiet] * np.exp((self._counted_s[quiet] - now_s) / _FALLS_S)
        self._counted_s[quiet] = now_s
        self._fell_s[due] = math.inf
