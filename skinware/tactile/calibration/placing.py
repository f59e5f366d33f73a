"""Where taxels are, from presses at known points: each is where its presses are, weighted by its load.

1. A taxel's place is first the median of its presses' points, weighted by load: one wrong press in ten does not matter.
2. A press is wrong if its point is far from where the taxels that felt it are, by their loads; it loses its weight.
3. Places become the weighted means, without what they are off because presses lie more to one side; 2 and 3 take turns.
4. Where the shapes of modules are known, each shape is brought onto the places of its taxels, and says where they all
   are, the untouched ones too, and which way they face.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.calibration.presses import Presses
from skinware.tactile.calibration.shapes import Shape, fitted

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]

_ROUNDS = 5
_WRONG = 4.0
"""A press this many typical residuals away has no weight."""
_LEAST_SPREAD_M = 0.0005
_TYPICAL = 1.1774
"""Of residuals in a plane: their median in standard deviations."""
_PRECISE_M = 0.0035
"""Of presses: where points are that good, loads count squared, which looks at the nearest alone."""
_LEAST_PRESSES = 2
_PARTS = 10
"""Into which the presses are parted, to see how much depends on each."""
_BIAS_M, _PRECISE_BIAS_M = 0.001, 0.0003
"""Of places, however many presses there are: skins end, gains differ."""


@dataclass(frozen=True)
class Placement:
    """Where n taxels are.

    Attributes:
        position_m: (n, 3), NaN where nothing tells.
        normal: (n, 3) outwards, of length 1; NaN where no shape tells.
        error_m: (n,) how far each may be off along the skin: an estimate of the root of the mean square; NaN where
            nothing tells.
        pressed: (n,) how many presses it has felt.
        residual_m: (m,) how far the point of each press is from where its taxels say.
        wrong: (m,) bool, presses that were left out.
    """

    position_m: ArrayF
    normal: ArrayF
    error_m: ArrayF
    pressed: ArrayI
    residual_m: ArrayF
    wrong: npt.NDArray[np.bool_]

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: the place is known."""
        known: npt.NDArray[np.bool_] = np.isfinite(self.position_m[:, 0])
        return known

    @property
    def spread_m(self) -> float:
        """The median residual of the presses that count; NaN if there is none."""
        counting = self.residual_m[~self.wrong]
        return float(np.median(counting)) if len(counting) else float("nan")


def place(presses: Presses, shapes: Mapping[int, Shape] | None = None, *, offset_m: float = 0.0) -> Placement:
    """Where the taxels are.

    Args:
        presses: with their points.
        shapes: of modules, by number; None: nothing is known of them.
        offset_m: from the taxels outwards to the points: the probe's radius and the cover. Needs shapes with normals.

    Raises:
        ConfigurationError: the presses have no points; an offset without normals.
    """
    if presses.pose.ndim != 2:
        raise ConfigurationError("presses with whole poses place a finger and modules: see place_finger")
    shapes = shapes or {}
    position = _medians(presses)
    trust = np.ones(len(presses))
    for _ in range(_ROUNDS):
        residual = _residuals(presses, position)
        trust = _trust(residual)
        is_precise = _spread(residual, trust) < _PRECISE_M
        position, normal = _places(presses, trust, shapes, is_precise)
    error = _errors(presses, trust, shapes, is_precise, position)
    if offset_m:
        if not np.isfinite(normal).all(axis=1).any():
            raise ConfigurationError(
                "an offset of the points needs the layout of modules with normals: which way is out?"
            )
        position = np.where(np.isfinite(normal), position - offset_m * normal, position)
    return Placement(position, normal, error, presses.times_pressed, residual, trust <= 0)


def _places(presses: Presses, trust: ArrayF, shapes: Mapping[int, Shape], is_precise: bool) -> tuple[ArrayF, ArrayF]:
    """(n, 3) places, and (n, 3) normals: weighted means, and where rigid modules bind them."""
    weight = trust[presses.press] * (presses.load**2 if is_precise else presses.load)
    position = _means(presses, weight)
    if is_precise:
        position = _unbiased(presses, trust, weight, position)
    normal = np.full_like(position, np.nan)
    presses_each = _presses_each(presses, weight)
    for shape in shapes.values():
        pose = fitted(shape, position[shape.taxel], presses_each[shape.taxel])
        if pose is not None:
            position[shape.taxel], normal[shape.taxel] = pose.places_m(shape), pose.normals(shape)
    return position, normal


def _unbiased(presses: Presses, trust: ArrayF, weight: ArrayF, position: ArrayF) -> ArrayF:
    """(n, 3) places, with what the mean of a bell would be off because its presses lie more to one side.

    The bell is as wide as the presses of a taxel typically spread; its gain does not matter.
    """
    off = presses.pose[presses.press] - position[presses.taxel]
    squares = np.nan_to_num((off**2).sum(axis=1))
    each = np.bincount(presses.taxel, weight, presses.n)
    width = np.bincount(presses.taxel, weight * squares, presses.n)[each > 0] / each[each > 0]
    if not len(width):
        return position
    bell = trust[presses.press] * np.exp(-squares / max(float(np.median(width)), _LEAST_SPREAD_M**2))
    return 2 * position - _means(presses, bell)


def _presses_each(presses: Presses, weight: ArrayF) -> ArrayF:
    """(n,) how many presses of equal weight would be worth as much."""
    total = np.bincount(presses.taxel, weight, presses.n)
    squares = np.bincount(presses.taxel, weight**2, presses.n)
    each: ArrayF = total**2 / np.where(squares > 0, squares, 1)
    return each


def _medians(presses: Presses) -> ArrayF:
    """(n, 3) the median of the points of each taxel's presses in each coordinate, weighted by load."""
    medians = np.full((presses.n, 3), np.nan)
    total = np.bincount(presses.taxel, presses.load, presses.n)
    pressed = np.flatnonzero(total > 0)
    if not len(pressed):
        return medians
    for axis in range(3):
        value = presses.pose[presses.press, axis]
        order = np.lexsort((value, presses.taxel))
        taxel, running = presses.taxel[order], np.cumsum(presses.load[order])
        before = np.concatenate([[0.0], np.cumsum(total)[:-1]])
        half = np.flatnonzero(running >= (before + total / 2)[taxel] * (1 - 1e-12))
        found, first = np.unique(taxel[half], return_index=True)
        medians[found, axis] = value[order][half[first]]
    return medians


def _residuals(presses: Presses, position: ArrayF) -> ArrayF:
    """(m,) how far the point of each press is from the centre of what felt it; inf where nothing did."""
    known = np.isfinite(position[presses.taxel]).all(axis=1)
    press, taxel, load = presses.press[known], presses.taxel[known], presses.load[known]
    m = len(presses)
    total = np.bincount(press, load, m)
    with np.errstate(invalid="ignore"):
        centre = (
            np.stack([np.bincount(press, load * position[taxel, axis], m) for axis in range(3)], 1) / total[:, None]
        )
    residual = np.linalg.norm(presses.pose - centre, axis=1)
    return np.where(np.isnan(residual), np.inf, residual)


def _spread(residual: ArrayF, trust: ArrayF) -> float:
    """The standard deviation of the residuals that count, along one axis, m."""
    counting = residual[trust > 0]
    return max(float(np.median(counting)) / _TYPICAL if len(counting) else 0.0, _LEAST_SPREAD_M)


def _trust(residual: ArrayF) -> ArrayF:
    """(m,) 0 to 1: the weight of each press, by Tukey's biweight."""
    finite = residual[np.isfinite(residual)]
    if not len(finite):
        return np.zeros_like(residual)
    limit = _WRONG * max(float(np.median(finite)) / _TYPICAL, _LEAST_SPREAD_M)
    trust: ArrayF = np.where(residual < limit, (1 - (np.minimum(residual, limit) / limit) ** 2) ** 2, 0.0)
    return trust


def _means(presses: Presses, weight: ArrayF) -> ArrayF:
    """(n, 3) the weighted means of the points; NaN without enough presses that count, or felt from the side alone."""
    total = np.bincount(presses.taxel, weight, presses.n)
    count = np.bincount(presses.taxel, weight > 0, presses.n)
    points = presses.pose[presses.press]
    sums = np.stack([np.bincount(presses.taxel, weight * points[:, axis], presses.n) for axis in range(3)], 1)
    enough = (total > 0) & (count >= _LEAST_PRESSES) & (presses.times_pressed > 0)
    return np.where(enough[:, None], sums / np.where(enough, total, 1)[:, None], np.nan)


def _errors(presses: Presses, trust: ArrayF, shapes: Mapping[int, Shape], is_precise: bool, position: ArrayF) -> ArrayF:
    """(n,) the error to expect: how much the places change without some of the presses (jackknife), and the bias."""
    squares = []
    for left_out in range(_PARTS):
        kept = np.arange(len(presses)) % _PARTS != left_out
        without, _ = _places(presses, trust * kept, shapes, is_precise)
        squares.append(((without - position) ** 2).sum(axis=1))
    changes = np.array(squares)
    told = np.isfinite(changes).sum(axis=0)
    mean = np.nansum(changes, axis=0) / np.maximum(told, 1)
    error = np.sqrt((_PARTS - 1) * mean + (_PRECISE_BIAS_M if is_precise else _BIAS_M) ** 2)
    return np.where(np.isfinite(position).all(axis=1) & (told > 0), error, np.nan)
