"""Gather the evidence of taxels' health: their noise, their use, and how they compare with the taxels around them."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.geometry import Geometry
from skinware.native import give_arrays, read_structs
from skinware.tactile.arrays import Doubles, Flags, Floats, Whole
from skinware.tactile.baseline import Calm
from skinware.tactile.health_relations import APART_S, KEPT, Exchanges
from skinware.tactile.neighbours import NONE, Table, pitch_m

_STRUCTS = read_structs([Path(native.__file__).with_name("health.h")])
_compare, _use = native.core().quick.skinware_health_compare, native.core().quick.skinware_health_use
_compare.argtypes, _compare.restype = (ctypes.c_void_p,), ctypes.c_int64
_use.argtypes, _use.restype = (ctypes.c_void_p, ctypes.c_double, ctypes.c_double), ctypes.c_int64
_BEGUN, _HARD, _PLAIN = 2, 4, 8

_PARTS = 9  # of a measurement of noise
_GROWTH = 1.2  # times: a noise grows by at most this from one measurement to the next
_ENOUGH_FRAMES = 11  # frames away from touches that a part needs; with fewer it goes on
_MODULE_APART_S = 5.0  # seconds: the same for a module, of which fingers touch one part after the other
_MOST_AT_ONCE = 2048  # touched taxels that are compared in one frame; if there are more, each frame takes another part
_NEAR_PITCHES = 1.3  # pitches: only the nearest ring of neighbours says much about the taxel in the middle
_OPPOSITE_COSINE = -0.9
"""Cosine of the angle from one neighbour to the other: they are opposite beyond some 155 degrees."""
_SETTLED_TOUCHES = 20  # touches after which what is due is known well
_RECENT_TOUCHES = 10  # hard touches over which a share is averaged: it is known well then
_HARD_SQUARE = 0.25  # part of the mean square of what was due: the share of a weaker touch says little
_BEST_KEPT = 0.9995
"""Part of the best share that a touch leaves: what a taxel showed is forgotten within thousands of touches."""
_EVEN = 1.4  # times: the farther of two opposite neighbours is at most this much farther than the nearer


class Noise:
    """Measures the noise of n taxels again and again, by the differences from sample to sample.

    A measurement has parts, and the noise is that of its median part: a press nearby makes differences only in some of
    them, and so does the release of a load under which a baseline was taken. A noise grows slowly, as presses may be in
    most of them. ``deviation`` and ``at_end``, the share of the time at an end of the range, are NaN before they are
    known. ``sums`` are (3, n), of squared differences, of samples, and of samples at an end of the range, of this part:
    of taxels that are neither touched nor far above their baselines, as at the beginning of a touch.
    """

    def __init__(self, sums: Floats, measured_s: float) -> None:
        n = sums.shape[1]
        self.deviation: Floats = np.full(n, np.nan, np.float32)
        self.at_end: Floats = np.full(n, np.nan, np.float32)
        self._part_s = measured_s / _PARTS
        self._begun_s, self._ended = 0.0, 0
        self._sums = sums
        self._squares, self._ends = np.full((2, _PARTS, n), np.nan, np.float32)
        self._n_parts: Whole = np.zeros(n, np.int64)

    def ends(self, now_s: float) -> bool:
        """Return whether a measurement ends with the newest sample."""
        if now_s - self._begun_s < self._part_s:
            return False
        self._begun_s = now_s
        self._end_parts()
        self._ended += 1
        return self._ended % _PARTS == 0

    def _end_parts(self) -> None:
        """End the parts that have samples enough; the others go on."""
        squares, frames, ends = self._sums
        enough = np.flatnonzero(frames >= _ENOUGH_FRAMES)
        part = self._n_parts[enough] % _PARTS
        self._squares[part, enough] = squares[enough] / (2 * frames[enough])
        self._ends[part, enough] = ends[enough] / frames[enough]
        self._sums[:, enough] = 0
        self._n_parts[enough] += 1
        known = enough[self._n_parts[enough] % _PARTS == 0]
        noise = np.sqrt(np.partition(self._squares[:, known], _PARTS // 2, axis=0)[_PARTS // 2])
        self.deviation[known] = np.fmin(noise, _GROWTH * self.deviation[known])
        self.at_end[known] = self._ends[:, known].mean(axis=0)


class Use:
    """Follows when n taxels changed, and how hard they and their modules were touched; each sample in C.

    The arrays are (n,), as ``skinware/native/health.h`` describes them. ``module_touched_s`` has the times of the last
    touches of each module, (n_modules, touches), the oldest first.
    """

    def __init__(self, module: npt.NDArray[np.intp], touches: int, limits: tuple[float, float]) -> None:
        n = len(module)
        self._module, self._words = module, _STRUCTS["Health"]()
        self._words.n = n
        self._words.least, self._words.most = limits
        self.arrays = give_arrays(self._words, n, {"sums": 3 * n})
        self.value: Floats = self.arrays["value"]
        self.value[:] = np.nan
        self.changed_s: Doubles = self.arrays["changed_s"]
        self.seen: Flags = self.arrays["seen"]
        self.touched: Flags = self.arrays["touched"]
        self.peak: Floats = self.arrays["peak"]
        self.usual: Floats = self.arrays["usual"]
        self.module_touched_s = np.full((int(module.max(initial=-1)) + 1, touches), -math.inf)
        self._at = ctypes.addressof(self._words)

    def compare(self, given: Floats, calm: Calm, clear: float) -> bool:
        """Compare the next sample with the values before it; a touch above ``clear`` is clear.

        Returns:
            Whether a taxel has jumped: ``moved``.
        """
        arrays = self.arrays
        arrays["given"][:], arrays["load"][:], arrays["baseline"][:] = given, calm.value, calm.baseline
        arrays["noise"][:], arrays["calm_touched"][:], arrays["usable"][:] = calm.noise, calm.touched, calm.usable
        self._words.clear = clear
        return bool(_compare(self._at))

    def take(self, now_s: float, passed_s: float, clear: float) -> tuple[bool, bool]:
        """Take the sample in; return whether there are hard touches, and plain ones."""
        self._words.clear = clear
        found = _use(self._at, now_s, passed_s)
        if found & _BEGUN:
            module = np.unique(self._module[self.arrays["begun"]])
            last = self.module_touched_s[module]
            module, last = (of[now_s - last[:, -1] >= _MODULE_APART_S] for of in (module, last))
            self.module_touched_s[module] = np.column_stack([last[:, 1:], np.full(len(module), now_s)])
        return bool(found & _HARD), bool(found & _PLAIN)


class Dues:
    """Compares n taxels with what is due to them: the geometric mean of both their sides, where both are touched.

    Attributes:
        due, shown: sums over the touches so far of due squared, and of due times shown; older ones count less.
        touches, hard_touches: separate touches of both sides, and those to which much was due.
        recent: the mean share of the last hard touches, each with the same weight.
        best: the largest of these means so far, at most 1; 0 before it is known well.
        exchanges: weak taxels that show what is due to others.
        frames: number of samples so far.
    """

    def __init__(self, geometry: Geometry | None, table: Table) -> None:
        n = len(table)
        self.exchanges = Exchanges(n)
        self.recent, self.best = np.zeros((2, n))
        self.hard_touches: Whole = np.zeros(n, np.int64)
        self._pairs = None if geometry is None else Pairs(geometry, table)
        self.frames = 0
        self.due, self.shown = np.zeros(n), np.zeros(n)
        self.touches: Whole = np.zeros(n, np.int64)
        self._hardest_due, self._hardest_shown = np.zeros(n), np.zeros(n)
        self._compared_s = np.full(n, -math.inf)

    def add(self, now_s: float, above: Floats, calm: Calm, hard: Flags) -> None:
        """Take a sample with clear touches in: its values above the baselines, and which taxels are clearly touched."""
        if self._pairs is None:
            return
        active = np.flatnonzero(hard)
        step = len(active) // _MOST_AT_ONCE + 1
        middle, one, other = self._pairs.around(active[self.frames % step :: step], hard)
        if not len(middle):
            return
        self._end_touches(np.unique(middle[now_s - self._compared_s[middle] >= APART_S]))
        self._compared_s[middle] = now_s
        shown, left, right = (np.maximum(above[taxel], 0) for taxel in (middle, one, other))
        due = np.sqrt(left * right)
        harder = np.flatnonzero(calm.usable[middle] & (due > self._hardest_due[middle]))
        harder = harder[np.argsort(due[harder], kind="stable")]  # of several pairs round a taxel the hardest stays
        self._hardest_due[middle[harder]], self._hardest_shown[middle[harder]] = due[harder], shown[harder]
        self.exchanges.note(middle[harder], above)

    def share_shown(self, touches: int) -> Doubles:
        """(n,) the share of its due that each taxel showed; NaN after fewer touches."""
        known = (self.touches >= touches) & (self.due > 0)
        share: Doubles = np.where(known, self.shown, math.nan) / np.where(known, self.due, 1)
        return share

    def _end_touches(self, taxels: Whole) -> None:
        due, shown = self._hardest_due[taxels], self._hardest_shown[taxels]
        self.due[taxels] = KEPT * self.due[taxels] + due * due
        self.shown[taxels] = KEPT * self.shown[taxels] + due * shown
        self.touches[taxels] += due > 0
        self._hardest_due[taxels] = 0
        self.exchanges.end(taxels, due)
        hard = due**2 > _HARD_SQUARE * self.due[taxels] / np.clip(self.touches[taxels], 1, _SETTLED_TOUCHES)
        ended, self.hard_touches[taxels] = taxels[hard], self.hard_touches[taxels] + hard
        count = np.minimum(self.hard_touches[ended], _RECENT_TOUCHES)
        self.recent[ended] += (shown[hard] / due[hard] - self.recent[ended]) / count
        settled = ended[count == _RECENT_TOUCHES]
        self.best[settled] = np.maximum(_BEST_KEPT * self.best[settled], np.minimum(self.recent[settled], 1))


class Pairs:
    """The pairs of taxels on opposite sides of each of n taxels, at about the same distance, where places are known."""

    def __init__(self, geometry: Geometry, table: Table) -> None:
        away_m = np.linalg.norm(geometry.position_m[table] - geometry.position_m[:, None], axis=2)
        close = (table != NONE) & (away_m > 0) & (away_m <= _NEAR_PITCHES * pitch_m(geometry)[:, None])
        nearest = np.argsort(~close, axis=1, kind="stable")[:, : int(close.sum(axis=1).max(initial=0))]
        ring = np.take_along_axis(np.where(close, table, np.int32(NONE)), nearest, axis=1)
        middle, one, other = _opposite(geometry, ring)
        first = np.argsort(one, kind="stable")
        count = np.bincount(one, minlength=len(geometry))
        shape = len(geometry), int(count.max(initial=0))
        column = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count)
        self._middle, self._other = np.full(shape, NONE, np.int32), np.full(shape, NONE, np.int32)
        self._middle[one[first], column], self._other[one[first], column] = middle[first], other[first]

    def around(self, taxels: Whole, touched: Flags) -> tuple[Whole, Whole, Whole]:
        """Find the taxels between two touched ones, of which these are one: (m,) those, the one side and the other.

        A taxel between several pairs is in several rows.
        """
        other = self._other[taxels]
        row, column = np.nonzero(touched[other] & (other != NONE))
        found = taxels[row]
        return self._middle[found, column].astype(np.int64), found, other[row, column].astype(np.int64)


def _opposite(geometry: Geometry, ring: Table) -> npt.NDArray[Any]:
    """(3, m): a taxel and two of its nearest neighbours, on opposite sides, the lower number first."""
    way_m = np.where((ring != NONE)[:, :, None], geometry.position_m[ring] - geometry.position_m[:, None], np.nan)
    length_m = np.linalg.norm(way_m, axis=2)
    found = [np.zeros((3, 0), np.int64)]
    for one in range(ring.shape[1]):
        for other in range(one + 1, ring.shape[1]):
            product = np.einsum("ij,ij->i", way_m[:, one], way_m[:, other])
            cosine = product / (length_m[:, one] * length_m[:, other])
            uneven = np.maximum(length_m[:, one] / length_m[:, other], length_m[:, other] / length_m[:, one])
            middle = np.flatnonzero((cosine <= _OPPOSITE_COSINE) & (uneven <= _EVEN))
            found.append(np.stack([middle, ring[middle, one], ring[middle, other]]))
    return np.concatenate(found, axis=1).astype(np.int64)
