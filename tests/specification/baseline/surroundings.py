"""Follow what contacts do to the taxels around them: they are held, they sag, and some were covered before."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tests.specification.baseline.numbers import DIP_S, SAG_RETURNS_BY, SAG_RETURNS_S, SAG_SHARE
from tests.specification.baseline.offsets import Grouping
from tests.specification.baseline.touches import Touches

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]


class Surroundings:
    """Follows what is near contacts of n taxels.

    Args:
        module: (n,) int, the module of each taxel.
        patch: (n,) int, the patch of each taxel.

    Attributes:
        module, patch: as given.
        n_modules: number of modules.
        busy: (n,) bool, something touches the patch, or did a moment ago: its cover may sag.
        is_back: (n,) bool, nothing touches the patch, and its cover has had the time to come back.
        held: (n,) bool, the taxels that are near a contact, or were in the last ``settle_s``.
        beside: (n,) bool, those of them that are near one now.
        largest: (n_patches,) the largest load of each patch, now or a moment ago.
        present: (n_patches,) the largest load now.
    """

    def __init__(self, module: Rows, patch: Rows) -> None:
        self.module, self.patch = module, patch
        self.n_modules = int(module.max(initial=-1)) + 1
        self.largest: Floats = np.zeros(int(patch.max(initial=-1)) + 1, np.float32)
        self.present: Floats = np.zeros_like(self.largest)
        self.busy: Flags = np.zeros(len(module), bool)
        self.is_back: Flags = np.ones(len(module), bool)
        self.held: Flags = np.zeros(len(module), bool)
        self.beside: Flags = np.zeros(len(module), bool)
        self._since_s = np.full(len(self.largest), np.inf)
        self._settling_s: Floats = np.zeros(len(module), np.float32)

    def hold(self, touches: Touches, live: Flags, passed_s: float, settle_s: float) -> None:
        """Find the taxels that are near a contact."""
        active = np.flatnonzero(touches.touched & live)
        if not len(active) and not (self.busy.any() or self.held.any()):
            return
        np.maximum(self._settling_s - np.float32(passed_s), 0, out=self._settling_s)
        self._since_s += passed_s
        over = self._since_s > max(settle_s, 1e-9)
        self.largest[over] = self.present[:] = 0
        if len(active):
            patch = self.patch[active]
            self._since_s[patch] = 0
            np.maximum.at(self.present, patch, touches.smooth[active])
            np.maximum(self.largest, self.present, out=self.largest)
            self._settling_s[self._near(active)] = max(settle_s, 1e-6)
        self.busy = (self._since_s <= settle_s)[self.patch]
        self.is_back = (self._since_s.astype(np.float32) > np.float32(SAG_RETURNS_S))[self.patch]
        self.held = self._settling_s > 0
        self.beside = self._settling_s >= np.float32(max(settle_s, 1e-6))

    def _near(self, active: Rows) -> Flags:
        touched_modules = np.zeros(self.n_modules, bool)
        touched_modules[self.module[active]] = True
        return touched_modules[self.module]

    def forget(self, taxels: Flags) -> None:
        """Drop what is known of some taxels."""
        self._settling_s[taxels] = 0


class Falls:
    """Follows n taxels that are below their offsets: they sag, were covered before, or a touch lowers them.

    Args:
        surroundings: what is near contacts.

    Attributes:
        below: (n,) bool, it is below its offset, and most of its patch is not.
        sagging: (n,) bool, it has sunk since something touches its patch: it comes back, and says nothing of drift.
        lowered: (n,) float32, how far it was below while no cover could pull it down; 0: it was not.
        returned: (n,) uint8, how often each returned to where it had fallen from: touches may lower it.
    """

    def __init__(self, surroundings: Surroundings) -> None:
        n = len(surroundings.module)
        self._around = surroundings
        self._below_s: Floats = np.zeros(n, np.float32)
        self._old_s = np.full(surroundings.n_modules, np.inf)
        """How long ago each module was touched by what is no new touch."""
        self._sunk: Floats = np.zeros(n, np.float32)
        """How far each has sagged since something touches its patch."""
        self.lowered: Floats = np.zeros(n, np.float32)
        self._felt: Flags = np.zeros(n, bool)
        """Which have ever risen under a touch: their polarity is right."""
        self._dip: Floats = np.zeros(n, np.float32)
        """How far each fell when it got its newest offset, for a while."""
        self._dip_s: Floats = np.zeros(n, np.float32)
        self.returned: npt.NDArray[np.uint8] = np.zeros(n, np.uint8)
        self._down_s: Floats = np.zeros(n, np.float32)
        """How long each has been far below."""
        self.below: Flags = np.zeros(n, bool)
        self.sagging: Flags = np.zeros(n, bool)

    def sag(
        self,
        smooth: Floats,
        off: Floats,
        rustle: Floats,
        rests: Flags,
        patches: Grouping,
        moves: Flags,
        passed_s: float,
    ) -> None:
        """Find the taxels at rest that are below their offsets by more than noise, unless most of their patch is.

        While a patch is touched, most of it may sag, unless its mode ``moves`` (n_patches,) by more than noise. A cover
        would be back soon after the touch: those that are as low then, farther than ``off``, were so before.
        """
        below = rests & (smooth < np.where(self.below, np.float32(0), -rustle))
        if below.any():
            common = patches.sum(below) > 0.5 * patches.sum(rests)
            common &= moves | (patches.sum(self._around.busy) == 0)
            if common.any():
                below &= ~common[self._around.patch]
        self.below = below
        depth = -smooth
        self._down_s = np.where(depth > off, self._down_s + np.float32(passed_s), np.float32(0))
        was_down = (self._down_s > SAG_RETURNS_S) & self._around.is_back
        self.lowered = np.where(was_down, depth, np.where(below, self.lowered, np.float32(0)))
        self.sagging = below & self._around.busy & ~((self.lowered > 0) & (depth <= self.lowered + off))
        self._sunk = np.where(self._around.is_back, np.float32(0), np.maximum(self._sunk, depth * self.sagging))

    def recovered(self, low: Flags, smooth: Floats, passed_s: float, after_s: float) -> Rows:
        """Return the taxels that are far below their offsets for ``after_s``, or below while no cover pulls."""
        due = self.lasts(low, passed_s, after_s)
        if self._around.largest.any():
            due &= -smooth > SAG_SHARE * self._around.largest[self._around.patch]
        due |= self.lowered > 0
        self._below_s[due] = self.lowered[due] = 0
        self._dip[due], self._dip_s[due] = -smooth[due], 0
        return np.flatnonzero(due)

    def lasts(self, low: Flags, passed_s: float, after_s: float) -> Flags:
        """Return (n,) the taxels that have been low for ``after_s``."""
        self._below_s = np.where(low, self._below_s + np.float32(passed_s), np.float32(0))
        lasts: Flags = self._below_s >= max(after_s, 1e-9)
        return lasts

    def back(self, touches: Touches, on: Floats, passed_s: float) -> Rows:
        """Return the new touches that are none: the taxels return to where they fell from, or sagged from."""
        self._old_s += passed_s
        looked, old = touches.looked(passed_s)
        self._old_s[self._around.module[old]] = 0
        self._felt |= old
        if self._dip.any():
            self._dip_s += np.float32(passed_s)
            self._dip[self._dip_s > DIP_S] = 0
        if not looked.any():
            return np.zeros(0, np.intp)
        rows = np.flatnonzero(looked)
        returns = (
            ~self._felt[rows] & (self._dip[rows] > 0) & (np.abs(touches.smooth[rows] - self._dip[rows]) < on[rows])
        )
        dipped = rows[returns]
        self.returned[dipped] = np.minimum(self.returned[dipped], 254) + 1
        self._dip[dipped] = 0
        old_s, sunk = self._old_s[self._around.module[rows]], self._sunk[rows]
        comes_back = (sunk > 0) & (touches.smooth[rows] < SAG_RETURNS_BY * sunk + on[rows])
        comes_back &= touches.remainders.since_end_s[rows] > 2 * SAG_RETURNS_S  # else its own touch flickers
        returns |= (old_s > 0) & (old_s < SAG_RETURNS_S) & comes_back
        none: Rows = rows[returns]
        return none
