"""What is wrong with a geometry: read from itself, and from strokes over the skin that it is for.

Strokes tell how far taxels are from each other. A module that is where the file says agrees with what lies round it.
If it does not, it may agree at the place of another one (connectors were exchanged), or as its mirror image, or turned.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.geometry import Geometry
from skinware.tactile.calibration.topology import Topology

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]
Groups = npt.NDArray[np.integer]

SHARED, UNKNOWN, SWAPPED, MIRRORED, TURNED, OFF = "shared", "unknown", "swapped", "mirrored", "turned", "off"

_SAME_PLACE_M = 1e-5
_OFF_M = 0.010
_CAP_M = 0.015
_NEAR_M = 0.009
"""Taxels that a file puts so near to each other must be felt together."""
_BAD_M = 0.0025
"""On average, of the distances of a module to what lies round it."""
_BETTER = 0.6
"""Another explanation must leave at most this part of the disagreement."""
_LEAST_DISTANCES = 6
_MOST_BAD = 64
"""So many groups are tried at each other's places, those that are farthest off."""
_TURNS = 24
_NEAREST = 6
"""So many measured neighbours say where a taxel is."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes:
        kind: ``shared``: taxels at one place; ``unknown``: without a place; ``swapped``: modules or patches at each
            other's places; ``mirrored``, ``turned``: a module; ``off``: a taxel that is more than 10 mm away.
        patches: their numbers, where whole patches are meant.
        modules: their numbers.
        taxels: (k,) those that are meant.
        off_m: how far the file is from what was measured, on average; NaN where that was not needed.
        degrees: by how much a module is turned; NaN otherwise.
    """

    kind: str
    taxels: ArrayI
    modules: tuple[int, ...] = ()
    patches: tuple[int, ...] = ()
    off_m: float = float("nan")
    degrees: float = float("nan")


def check_file(geometry: Geometry, module: npt.NDArray[np.integer]) -> list[Finding]:
    """What a geometry tells against itself: places that taxels share, taxels without a place.

    Args:
        geometry: of n taxels.
        module: (n,) of each.
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
    geometry: Geometry,
    module: npt.NDArray[np.integer],
    patch: npt.NDArray[np.integer],
    topology: Topology,
) -> list[Finding]:
    """What strokes tell against a geometry.

    Args:
        geometry: of n taxels.
        module: (n,) of each.
        patch: (n,) of each.
        topology: of the same taxels.
    """
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
        self, taxels: ArrayI, group: Groups, place: ArrayF | None = None, frame: ArrayI | None = None
    ) -> float:
        """How far measured distances from taxels to those of other groups are from what places say, on average.

        Taxels that are said to be near each other and were never felt together disagree, too.

        Args:
            taxels: (k,).
            group: (n,) of all taxels.
            place: (n, 3) where they are; None: where the file says.
            frame: (n,) of the places.

        Returns:
            NaN if there are too few.
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

    def swapped(self, group: Groups, named: npt.NDArray[np.bool_]) -> Iterator[tuple[ArrayI, tuple[int, int], float]]:
        """Groups of as many taxels that agree at each other's places, and do not at their own, the clearest pair first.

        From then on they are taken to be there: an exchange disturbs its neighbours.

        Yields:
            Of each pair of groups: their taxels, their numbers, and how far they are off where the file says.
        """
        while found := self._clearest_swap(group, named):
            _, both, there, pair, own = found
            self._place[both], self._frame[both] = self._place[there], self._frame[there]
            named[both] = True
            yield both, pair, own

    def _clearest_swap(
        self, group: Groups, named: npt.NDArray[np.bool_]
    ) -> tuple[float, ArrayI, ArrayI, tuple[int, int], float] | None:
        """Of the best pair: how much of the disagreement is left, their taxels, where those belong, numbers, off."""
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

    def turned(self, module: Groups, named: npt.NDArray[np.bool_]) -> Iterator[Finding]:
        """Modules that agree as their mirror image, or turned about their normal, and not as they are."""
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

    def off(self, module: Groups, named: npt.NDArray[np.bool_]) -> Iterator[Finding]:
        """Taxels that are more than 10 mm from where the nearest ones say."""
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


def _turns(places: ArrayF) -> Iterator[tuple[bool, float, ArrayF]]:
    """Places of a module turned about their middle in their plane, and the same of their mirror image."""
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
