"""Find the moment in which a contact begins to slip: its pattern moves by more than noise and load explain.

All is in units of the noise. With s, the number of standard deviations by which each taxel of a contact is above its
baseline, the centre of the pattern is the mean of the places, weighted by s². So weighted, it moves as far as the
pattern does, and its standard deviation along an axis is r (2 / Σ s²)^½ for a pattern of radius r.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Doubles, Flags, Whole

Patterns = npt.NDArray[np.void]

_SIGMA = 5.0
"""Standard deviations of its noise by which a pattern must have moved: by chance once an hour."""
_QUICK_S, _SLOW_S = np.array([[0.003], [0.006]]), np.array([[0.02], [0.04]])
"""Time constants of two pairs of smoothed centres; a pattern has moved where the two of a pair are apart, s."""
_CREEP_M_S = 0.0005
"""m/s: speed of a pattern whose object creeps or whose elastomer settles."""
_SETTLES_S = 0.15
"""Time constant for which a change of the load may move the pattern, s."""
_LOAD_SIGMA = 3.0  # standard deviations by which a load must differ to have changed
_STOPS = 0.5  # share of the limit below which a contact no longer slips

_PATTERN = np.dtype(
    [
        ("id", "i8"),
        ("quick", "f8", (2, 3)),
        ("slow", "f8", (2, 3)),
        ("spread", "f8", (2, 3)),  # variances of quick, of slow, and of both together, along an axis
        ("load", "f8"),  # smoothed
        ("swing", "f8"),  # by how much the load has changed of late
        ("slips", "?"),
    ]
)


class Slips:
    """Watches the patterns of contacts on n taxels for slip.

    Args:
        position_m: (n, 3) m, places of the taxels, in the frame of the contact.
        pitch_m: of the taxels, m; NaN if it is not known.
    """

    def __init__(self, position_m: Doubles, pitch_m: float) -> None:
        self._position_m = position_m
        self._least_radius_m = float(np.nan_to_num(pitch_m)) / 6**0.5  # of one taxel, a square as wide as the pitch
        self._patterns = np.zeros(0, _PATTERN)
        self._id_of = np.zeros(len(position_m), np.int64)  # 0: none
        self._is_known = np.zeros(len(position_m), bool)
        self._time_ns = 0

    def update(self, identity: Whole, taxels: Whole, contact: Whole, sigmas: Doubles, time_ns: int) -> Flags:
        """Return (m,) bool, which of the m contacts of the next frame slip.

        Args:
            identity: (m,) of the contacts.
            taxels: (a,) that belong to them.
            contact: (a,) the contact of each.
            sigmas: (n,) by how many standard deviations of its noise each taxel is above its baseline; NaN: not known.
            time_ns: when the frame was acquired.
        """
        passed_s, self._time_ns = max(time_ns - self._time_ns, 0) / NS_PER_S, time_ns
        patterns, centre, radius_m, load = self._measure(identity, taxels, contact, sigmas)
        variance = 2 * (radius_m / load) ** 2
        row_of = {one: row for row, one in enumerate(self._patterns["id"].tolist())}
        before = np.array([row_of.get(one, -1) for one in identity.tolist()], np.int64)
        before[self._is_other(identity, taxels, contact, sigmas)] = -1
        old, row = np.flatnonzero(before >= 0), before[before >= 0]
        patterns["quick"], patterns["slow"] = centre[:, None], centre[:, None]
        patterns["spread"] = variance[:, None, None]
        patterns["load"] = patterns["swing"] = load
        if len(old):
            was, now = self._patterns[row], patterns[old]
            quick, slow = -np.expm1(-passed_s / _QUICK_S), -np.expm1(-passed_s / _SLOW_S)
            now["quick"] = was["quick"] + quick * (now["quick"] - was["quick"])
            now["slow"] = was["slow"] + slow * (now["slow"] - was["slow"])
            own = np.hstack([quick**2, slow**2, quick * slow])
            kept = np.hstack([(1 - quick) ** 2, (1 - slow) ** 2, (1 - quick) * (1 - slow)])
            now["spread"] = kept * was["spread"] + own * now["spread"]
            now["load"] = was["load"] + slow[0] * (load[old] - was["load"])
            changed = np.maximum(abs(load[old] - now["load"]) - _LOAD_SIGMA, 0)
            now["swing"] = np.maximum(was["swing"] * np.exp(-passed_s / _SETTLES_S), changed)
            now["slips"] = _slips(now, was["slips"], radius_m[old] / load[old])
            patterns[old] = now
        self._patterns = patterns
        slips: Flags = patterns["slips"].copy()
        return slips

    def _measure(
        self, identity: Whole, taxels: Whole, contact: Whole, sigmas: Doubles
    ) -> tuple[Patterns, Doubles, Doubles, Doubles]:
        """Return new patterns, their centres and radii, m, and their loads in standard deviations; NaN: not known."""
        m, position = len(identity), self._position_m[taxels]
        patterns = np.zeros(m, _PATTERN)
        patterns["id"] = identity
        weight = sigmas[taxels] ** 2
        total = np.bincount(contact, weight, m)
        total = np.where(total > 0, total, np.nan)
        centre = np.column_stack([np.bincount(contact, weight * axis, m) for axis in position.T]) / total[:, None]
        squares = ((position - centre[contact]) ** 2).sum(axis=1)
        radius_m = np.maximum(np.sqrt(np.bincount(contact, weight * squares, m) / total), self._least_radius_m)
        return patterns, centre, radius_m, np.sqrt(total)

    def _is_other(self, identity: Whole, taxels: Whole, contact: Whole, sigmas: Doubles) -> Flags:
        """Return (m,) bool, which contacts begin again: they merged or split, or taxels of theirs came or went."""
        was, known_before = self._id_of, self._is_known
        self._id_of, self._is_known = np.zeros_like(was), np.isfinite(sigmas)
        self._id_of[taxels] = identity[contact]
        moved = (was > 0) & (self._id_of > 0) & (was != self._id_of)
        moved |= ((was > 0) | (self._id_of > 0)) & (known_before != self._is_known)
        if not moved.any():
            return np.zeros(len(identity), bool)
        other: Flags = np.isin(identity, np.concatenate([was[moved], self._id_of[moved]]))
        return other


def _slips(patterns: Patterns, slipped: Flags, per_load_m: Doubles) -> Flags:
    """Return (m,) bool, which have moved farther than noise, creep and a change of the load at the rim explain."""
    moved_m = np.linalg.norm(patterns["quick"] - patterns["slow"], axis=2)
    sigma_m = np.sqrt(np.maximum(patterns["spread"] @ np.array([1.0, 1.0, -2.0]), 0))
    explained_m = np.maximum(_CREEP_M_S * (_SLOW_S - _QUICK_S).T, (per_load_m * patterns["swing"])[:, None])
    limit_m = (_SIGMA * sigma_m + explained_m) * np.where(slipped, _STOPS, 1.0)[:, None]
    slips: Flags = (moved_m > limit_m).any(axis=1)
    return slips
