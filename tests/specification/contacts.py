"""Find, measure and list contacts, and find their slips: what ``contacts.c`` and ``slips.c`` do, in numpy."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.tactile.arrays import Doubles, Flags, Whole
from skinware.tactile.contacts import BEYOND, COLUMNS, MOST, NO_CONTACT
from skinware.tactile.neighbours import NONE, Table, area_m2, checked, pitch_m
from skinware.tactile.tracking import Tracker
from skinware.tactile.tracks import TouchedBlobs

CLEARLY, LEAST_SHARE = 1.5, 0.1
LEAST_SEEN, MOST_CUT, CLEAR = 0.5, 0.6, 4.0


class SpecifiedComponents:
    """Finds the components of touched taxels."""

    def __init__(self, n: int, neighbours: npt.NDArray[Any] | None, module: npt.NDArray[Any] | None = None) -> None:
        table = np.zeros((n, 0), np.int32) if neighbours is None else checked(neighbours, n)
        row, column = np.nonzero(table > np.arange(n)[:, None])
        self._forward = _filled(row, table[row, column], n)  # each pair once, in the row of the lower number
        self._is_lonely = (table == NONE).all(axis=1)
        self._module = module if self._is_lonely.any() else None
        self._position = np.full(n + 1, NONE, np.int32)  # among those that are touched; the last one is that of NONE

    def of(self, touched: Whole) -> tuple[Whole, int]:
        """Return (m,) int64 the component of each of m taxels, counted from 0 in their order; and their number.

        ``touched`` is (m,) int64, ascending.
        """
        self._position[touched] = np.arange(len(touched))
        beside = self._position[self._forward[touched]].reshape(-1)
        self._position[touched] = NONE
        pair = np.flatnonzero(beside != NONE)
        one, other = pair // max(1, self._forward.shape[1]), beside[pair].astype(np.int64)
        if self._module is not None:
            lonely = np.flatnonzero(self._is_lonely[touched])
            _, first, module = np.unique(self._module[touched[lonely]], return_index=True, return_inverse=True)
            one, other = np.concatenate([one, lonely[first][module]]), np.concatenate([other, lonely])
        root = _roots(len(touched), one, other)
        is_root = root == np.arange(len(touched))
        number = np.cumsum(is_root) - 1
        return number[root], int(is_root.sum())


def _roots(count: int, low: Whole, high: Whole) -> Whole:
    """(count,) int64: the smallest member of the component of each, for edges from ``low`` to higher numbers."""
    root = np.arange(count)
    while len(low):
        np.minimum.at(root, high, low)
        while not np.array_equal(root, upper := root[root]):
            root = upper
        one, other = root[low], root[high]
        apart = one != other
        one, other = one[apart], other[apart]
        low, high = np.minimum(one, other), np.maximum(one, other)
    return root


def _filled(row: Whole, number: npt.NDArray[np.integer], n: int) -> Table:
    """A table with numbers in n rows, given row by row."""
    count = np.bincount(row, minlength=n)
    table = np.full((n, int(count.max(initial=0))), NONE, np.int32)
    table[row, np.arange(len(row)) - (np.cumsum(count) - count)[row]] = number
    return table


class SpecifiedContacts:
    """Finds and follows the contacts of n taxels."""

    def __init__(
        self, n: int, neighbours: npt.NDArray[Any] | None, geometry: Geometry, module: npt.NDArray[Any], unit: str
    ) -> None:
        self._n, self._unit = n, unit
        self._components = SpecifiedComponents(n, neighbours, module)
        area = area_m2(geometry)
        of_taxel = [geometry.position_m, geometry.normal, area[:, None], np.isfinite(area)[:, None]]
        self._of_taxel = np.nan_to_num(np.hstack(of_taxel).astype(np.float64))
        self._least = 0.0
        known = np.isfinite(geometry.position_m).all(axis=1)
        self._frame = np.full(n, -1, np.int64)
        self._frame[known] = np.unique(geometry.frame[known].astype(str), return_inverse=True)[1]
        median_m = float(np.nanmedian(pitch_m(geometry)))
        self._tracker = Tracker(self._of_taxel[:, :3], median_m)
        self._slips = Slips(self._of_taxel[:, :3], median_m)

    def update(
        self,
        value: npt.NDArray[Any],
        touched: Flags,
        time_ns: int,
        onset: Flags,
        clipped: Flags,
        uncertainty: npt.NDArray[Any],
        sigmas: npt.NDArray[Any],
    ) -> tuple[dict[str, npt.NDArray[Any]], npt.NDArray[np.int16], int]:
        """Return the columns of the contacts of the next frame, the row of each taxel, and how many have none."""
        taxels = np.flatnonzero(touched | onset)
        contact_of = np.full(self._n, NO_CONTACT, np.int16)
        contact, count = self._components.of(taxels)
        load = value[taxels].astype(np.float64)
        load = np.where(np.isfinite(load) & (load > 0), load, 0.0)
        beyond = max(0, count - MOST)
        if beyond:
            contact_of[taxels] = BEYOND
            listed = self._tracker.track_of[taxels] >= 0
            taxels, contact, load = _largest(taxels, contact, load, count, listed)
            count = MOST
        found = self._measure(taxels, contact, load, count)
        is_sure = np.bincount(contact, touched[taxels], count) > 0
        is_clear = np.bincount(contact, load >= CLEAR * uncertainty[taxels], count) > 0
        frames = np.where(np.bincount(contact, onset[taxels], count) > 0, 2, is_clear.astype(np.int64))
        blobs = TouchedBlobs(
            taxels, contact, load, found["load"], found["peak"], found["frame"], found["cop_m"], is_sure, frames
        )
        cut = np.bincount(contact, clipped[taxels], count).astype(np.float64)
        unsure = np.bincount(contact, uncertainty[taxels], count)
        found |= {"clipped": cut, "uncertainty": unsure, "load_whole": self._whole(found, cut, load)}
        found |= self._tracker.follow(blobs, time_ns)
        order = np.lexsort([found["id"], -found["age_s"]])
        order = order[found["id"][order] > 0]
        row = np.full(count, NO_CONTACT)
        row[order] = np.arange(len(order))
        contact_of[taxels] = row[contact]
        found["slips"] = np.zeros(count, bool)
        found["slips"][order] = self._slipping(found["id"][order], found["frame"][order], contact_of, sigmas, time_ns)
        columns = {name: found[name][order].astype(dtype) for name, (dtype, *_) in COLUMNS.items()}
        return columns, contact_of, beyond

    def _slipping(
        self, identity: Whole, frame: Whole, contact_of: npt.NDArray[np.int16], sigmas: npt.NDArray[Any], time_ns: int
    ) -> Flags:
        """(m,) which of the m contacts that have rows slip."""
        taxels = np.flatnonzero(contact_of >= 0)
        contact = contact_of[taxels].astype(np.int64)
        counts = (frame[contact] == self._frame[taxels]) & (frame[contact] >= 0) & np.isfinite(sigmas[taxels])
        return self._slips.update(identity, taxels[counts], contact[counts], sigmas, time_ns)

    def _measure(self, taxels: Whole, contact: Whole, load: Doubles, count: int) -> dict[str, npt.NDArray[Any]]:
        order = np.argsort(contact, kind="stable")
        taxels, contact, load = taxels[order], contact[order], load[order]
        first = np.searchsorted(contact, np.arange(count))  # each contact has at least one taxel
        peak = np.maximum.reduceat(load, first) if count else np.zeros(0)
        frame = self._frame_of(taxels, contact, load, peak)
        of_taxel = self._of_taxel[taxels]
        counts = (frame[contact] == self._frame[taxels]) & (frame[contact] >= 0)
        weight = np.where(counts, load, 0.0)
        if count:  # without any load, each taxel weighs the same
            weight += counts * (np.add.reduceat(weight, first) == 0)[contact]
        parts = np.column_stack(
            [load, load * of_taxel[:, 6], weight, of_taxel[:, 6:], weight[:, None] * of_taxel[:, :6]]
        )
        total = np.add.reduceat(parts, first, axis=0) if count else np.zeros((0, parts.shape[1]))
        loads, forces, weights, areas, with_area = total[:, :5].T
        has_area, normal = with_area > 0, total[:, 8:]
        length = np.sqrt((normal**2).sum(axis=1))
        return {
            "load": loads,
            "peak": peak,
            "n": np.bincount(contact, minlength=count),
            "area_m2": np.where(has_area, areas, np.nan),
            "force_n": {"N": loads, "Pa": np.where(has_area, forces, np.nan)}.get(self._unit, np.full(count, np.nan)),
            "cop_m": total[:, 5:8] / np.where(weights > 0, weights, np.nan)[:, None],
            "normal": normal / np.where(length > 0, length, np.nan)[:, None],
            "frame": frame,
        }

    def _whole(self, found: dict[str, npt.NDArray[Any]], cut: Doubles, load: Doubles) -> Doubles:
        """(count,) the loads of bells of which only the part above the threshold and below the clipping was seen."""
        if len(load) and (load > 0).any():
            least = float(load[load > 0].min())
            self._least = least if not self._least else self._least + LEAST_SHARE * (least - self._least)
        peak, share = np.maximum(found["peak"], self._least), cut / found["n"]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            seen = 1 - self._least / peak
            whole = np.where(seen >= LEAST_SEEN, found["load"] / seen, np.nan)
            if not cut.any():
                return whole
            top = (peak / self._least**share) ** (1 / (1 - share))
            of_cut = found["n"] * top / np.log(top / self._least)
        return np.where(cut > 0, np.where(share <= MOST_CUT, of_cut, np.nan), whole)

    def _frame_of(self, taxels: Whole, contact: Whole, load: Doubles, peak: Doubles) -> Whole:
        """(count,) the frame in which each contact has its largest value; -1 if no place is known."""
        placed = self._frame[taxels] >= 0
        if not placed.all():  # the largest value at a known place
            peak = np.full(len(peak), -1.0)
            np.maximum.at(peak, contact[placed], load[placed])
        is_largest = placed & (load == peak[contact])
        frame = np.full(len(peak), -1)
        frame[contact[is_largest]] = self._frame[taxels[is_largest]]
        return frame


def _largest(taxels: Whole, contact: Whole, load: Doubles, count: int, listed: Flags) -> tuple[Whole, Whole, Doubles]:
    """Those of the largest contacts; one that was listed stays unless another is clearly larger."""
    loads = np.bincount(contact, load, count)
    loads *= np.where(np.bincount(contact, listed, count) > 0, CLEARLY, 1.0)
    kept = np.sort(np.argsort(-loads, kind="stable")[:MOST])
    number = np.full(count, -1)
    number[kept] = np.arange(MOST)
    number = number[contact]
    is_kept = number >= 0
    return taxels[is_kept], number[is_kept], load[is_kept]


Patterns: TypeAlias = Any  # an array with fields; as such it takes mypy seconds

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
