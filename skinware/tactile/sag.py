"""Taxels that sink while something touches their patch: what they lose comes back when it is gone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_COMES_BACK_S = 0.5
"""So soon after the end of a contact."""
_AT_MOST = 1.5
"""Times what a taxel has sunk, it may come back by, and the threshold beyond."""

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]


class Sag:
    """Remembers how far the baselines of n taxels went down while their patch was touched.

    A cover that is pressed sinks around the contact, farther than the module that is held. Free taxels there follow it
    down, and must go up again when the contact is over, or what comes back would be a touch.

    Args:
        module: (n,) int, the module of each taxel.
        patch: (n,) int, the patch of each taxel.
    """

    def __init__(self, module: Rows, patch: Rows) -> None:
        self._module, self._patch = module, patch
        self._patch_of_module = np.zeros(int(module.max(initial=-1)) + 1, np.intp)
        self._patch_of_module[module] = patch
        self._is_touched = np.zeros(len(self._patch_of_module), bool)
        self._in_contact = np.zeros(int(patch.max(initial=-1)) + 1, bool)
        self._since_end_s = np.full(len(self._in_contact), np.inf)
        self._sunk: Floats = np.zeros(len(module), np.float32)

    def sink(self, by: Floats) -> None:
        """Baselines went down (n,) so far beside common drift; up, below 0."""
        if self._in_contact.any():
            self._sunk += by * self._in_contact[self._patch]
            np.maximum(self._sunk, 0, out=self._sunk)

    def come_back(self, deviation: Floats, touched: Flags, off: Floats, passed_s: float) -> Floats:
        """Follow the contacts; (n,) how far the baselines of those whose sag is over have to go up.

        Args:
            deviation: (n,) of the values from the baselines.
            touched: (n,) which taxels were touched in the last frame.
            off: (n,) threshold below which a touch ends.
            passed_s: since the last frame.
        """
        is_touched = np.zeros(len(self._is_touched), bool)
        is_touched[self._module[touched]] = True
        self._since_end_s += passed_s
        self._since_end_s[self._patch_of_module[self._is_touched & ~is_touched]] = 0
        self._is_touched = is_touched
        self._in_contact[:] = False
        self._in_contact[self._patch_of_module[is_touched]] = True
        is_ending = self._since_end_s < _COMES_BACK_S
        if not is_ending.any():
            if not self._in_contact.all():
                self._sunk *= self._in_contact[self._patch]
            return np.zeros_like(self._sunk)
        is_back = is_ending[self._patch] & (deviation > off) & (deviation < _AT_MOST * self._sunk + off)
        up = self._sunk * is_back
        self._sunk -= up
        return up
