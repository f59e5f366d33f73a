"""Find the errors of a geometry, by itself and by strokes over its skin.

Strokes give the distances between taxels. A module at its right place agrees with its surroundings. A module that does
not may agree at the place of another one (exchanged connectors), as its mirror image, or turned.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.tactile.arrays import Doubles, Flags, Whole
from skinware.tactile.calibration.topology import Topology

Groups = npt.NDArray[np.integer]

SHARED, UNKNOWN, SWAPPED, MIRRORED, TURNED, OFF = "shared", "unknown", "swapped", "mirrored", "turned", "off"

_SAME_PLACE_M = 1e-5
_OFF_M = 0.010
_CAP_M = 0.015
_NEAR_M = 0.009  # taxels that a file puts nearer to each other than this must be felt together
_BAD_M = 0.0025  # mean disagreement of a module with its surroundings from which it is wrong
_BETTER = 0.6  # share of the disagreement that another explanation may leave
_LEAST_DISTANCES = 6
_MOST_BAD = 64  # groups that are tried at each other's places, those that are farthest off
_TURNS = 24
_NEAREST = 6  # measured neighbours that determine the place of a taxel


@dataclass(frozen=True)
class Finding:
    """An error of a geometry.

    Attributes:
        kind: ``shared``: taxels at one place; ``unknown``: without a place; ``swapped``: modules or patches at each
            other's places; ``mirrored``, ``turned``: a module; ``off``: a taxel that is more than 10 mm away.
        taxels: (k,) the wrong taxels.
        modules: numbers of the wrong modules.
        patches: numbers of the wrong patches, if whole patches are wrong.
        off_m: mean distance of the file from the measurement; NaN where it was not measured.
        degrees: by how much a module is turned; NaN otherwise.
    """

    kind: str
    taxels: Whole
    modules: tuple[int, ...] = ()
    patches: tuple[int, ...] = ()
    off_m: float = float("nan")
    degrees: float = float("nan")


def check_file(geometry: Geometry, module: npt.NDArray[np.integer]) -> list[Finding]:
    """Return the errors that a geometry of n taxels shows by itself: shared places, taxels without a place.

    ``module`` is (n,), the module of each.
    """
    found: list[Finding] = []
    known = np.flatnonzero(geometry.known)
    cell = np.round(geometry.position_m[known] / _SAME_PLACE_M)
    _, frame = np.unique(geometry.frame[known].astype(str), return_inverse=True)
    _, place, count = np.unique(np.column_stack([frame, cell]), axis=0, return_inverse=True, return_counts=True)
    place = place.reshape(-1)
    sharing: dict[tuple[int, ...], list[int]] = {}
    for number in np.flatnonzero(count > 1).tolist():
        taxels = known[place == number]
        sharing.setdefault(tuple(np.unique(module[taxels]).tolist()), []).extend(taxels.tolist())
    found += [Finding(SHARED, np.array(taxels), modules) for modules, taxels in sharing.items()]
    lost = np.flatnonzero(~geometry.known)
    if len(lost):
        found.append(Finding(UNKNOWN, lost, tuple(np.unique(module[lost]).tolist())))
    return found


def check_strokes(
    geometry: Geometry, module: npt.NDArray[np.integer], patch: npt.NDArray[np.integer], topology: Topology
) -> list[Finding]:
    """Return the errors of a geometry of n taxels by strokes, with (n,) modules and patches, and their topology."""
    check = _Check(geometry, topology)
    named = np.zeros(len(geometry), bool)
    found: list[Finding] = []
    for taxels, pair, off_m in check.swapped(patch, named):
        found.append(Finding(SWAPPED, taxels, patches=pair, off_m=off_m))
    for taxels, pair, off_m in check.swapped(module, named):
        found.append(Finding(SWAPPED, taxels, pair, off_m=off_m))
    for finding in check.turned(module, named):
        named[finding.taxels] = True
        found.append(finding)
    return found + list(check.off(module, named))


class _Check:
    """Compares places with measured distances."""

    def __init__(self, geometry: Geometry, topology: Topology) -> None:
        self._place = geometry.position_m.copy()
        _, self._frame = np.unique(geometry.frame.astype(str), return_inverse=True)
        self._known = geometry.known & (topology.piece >= 0)
        self._distance = topology.distance_m

    def _disagreement_m(
        self, taxels: Whole, group: Groups, place: Doubles | None = None, frame: Whole | None = None
    ) -> float:
        """The mean difference between measured and given distances from taxels to those of other groups; NaN: too few.

        Taxels that are near each other in the file and were never felt together disagree, too. (n, 3) places and (n,)
        frames are those of the file unless they are given.
        """
        place = self._place if place is None else place
        frame = self._frame if frame is None else frame
        rows = taxels[self._known[taxels]]
        measured = self._distance[rows]
        said = np.linalg.norm(place[rows, None] - place, axis=2)
        said[frame[rows, None] != frame] = np.inf
        tells = (np.isfinite(measured) | (said < _NEAR_M)) & (group[rows, None] != group) & self._known
        if tells.sum() < _LEAST_DISTANCES:
            return float("nan")
        return float(np.minimum(abs(measured[tells] - said[tells]), _CAP_M).mean())

    def swapped(self, group: Groups, named: Flags) -> Iterator[tuple[Whole, tuple[int, int], float]]:
        """Yield pairs of groups that agree at each other's places and not at their own, the clearest first.

        Each is its taxels, its numbers, and how far it is off at the places of the file. Each pair is exchanged before
        the search goes on, as an exchange disturbs its neighbours.
        """
        while found := self._clearest_swap(group, named):
            _, both, there, pair, own = found
            self._place[both], self._frame[both] = self._place[there], self._frame[there]
            named[both] = True
            yield both, pair, own

    def _clearest_swap(self, group: Groups, named: Flags) -> tuple[float, Whole, Whole, tuple[int, int], float] | None:
        """The best pair: share of the disagreement that is left, its taxels, their right places, numbers, distance."""
        taxels_of = {number: np.flatnonzero(group == number) for number in np.unique(group[~named]).tolist()}
        off = {number: self._disagreement_m(taxels, group) for number, taxels in taxels_of.items()}
        bad = sorted((number for number in off if off[number] > _BAD_M), key=lambda number: -off[number])[:_MOST_BAD]
        candidates = []
        for one, other in itertools.combinations(sorted(bad), 2):
            first, second = taxels_of[one], taxels_of[other]
            if len(first) != len(second):
                continue
            both, there = np.concatenate([first, second]), np.concatenate([second, first])
            place, frame = self._place.copy(), self._frame.copy()
            place[both], frame[both] = place[there], frame[there]
            own, crossed = self._disagreement_m(both, group), self._disagreement_m(both, group, place, frame)
            if crossed < _BETTER * own:
                candidates.append((crossed / own, both, there, (one, other), own))
        return min(candidates, key=lambda candidate: candidate[0], default=None)

    def turned(self, module: Groups, named: Flags) -> Iterator[Finding]:
        """Yield modules that agree as their mirror image, or turned about their normal, and not as they are."""
        for number in np.unique(module[~named]).tolist():
            taxels = np.flatnonzero((module == number) & self._known & ~named)
            if len(taxels) < _LEAST_DISTANCES or len(np.unique(self._frame[taxels])) > 1:
                continue
            as_is = self._disagreement_m(taxels, module)
            if not as_is > _BAD_M:
                continue
            tried = []
            for mirrored, degrees, places in _turns(self._place[taxels]):
                place = self._place.copy()
                place[taxels] = places
                tried.append((self._disagreement_m(taxels, module, place), mirrored, degrees))
            best, mirrored, degrees = min(tried)
            if best < _BETTER * as_is:
                kind = MIRRORED if mirrored else TURNED
                yield Finding(kind, taxels, (number,), off_m=as_is, degrees=float("nan") if mirrored else degrees)

    def off(self, module: Groups, named: Flags) -> Iterator[Finding]:
        """Yield taxels more than 10 mm away from their nearest ones."""
        trusted = np.flatnonzero(self._known & ~named)
        nearest = np.argsort(self._distance[np.ix_(trusted, trusted)], axis=1, kind="stable")[:, :_NEAREST]
        for row, taxel in enumerate(trusted.tolist()):
            others = trusted[nearest[row]]
            others = others[np.isfinite(self._distance[taxel, others])]
            if len(others) < 3:
                continue
            if (self._frame[others] == self._frame[taxel]).mean() <= 0.5:
                continue
            away = self._place[taxel] - np.median(self._place[others], axis=0)
            measured = float(np.median(self._distance[taxel, others]))
            if float(np.linalg.norm(away)) - measured > _OFF_M:
                yield Finding(OFF, np.array([taxel]), (int(module[taxel]),), off_m=float(np.linalg.norm(away)))


def _turns(places: Doubles) -> Iterator[tuple[bool, float, Doubles]]:
    """Places of a module, and of its mirror image, turned about their middle in their plane."""
    middle = places.mean(axis=0)
    axes = np.linalg.svd(places - middle, full_matrices=False)[2]
    flat = (places - middle) @ axes.T
    for mirrored in (False, True):
        image = flat * [1.0, -1.0 if mirrored else 1.0, 1.0][: flat.shape[1]]
        for step in range(_TURNS):
            angle = 2 * np.pi * step / _TURNS
            if not mirrored and not step:
                continue
            turn = np.eye(3)
            turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            degrees = float(np.degrees(angle))
            yield mirrored, min(degrees, 360 - degrees), middle + image @ turn.T @ axes
