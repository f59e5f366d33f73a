"""Place taxels from presses at known points: each at the mean of its presses, weighted by its load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Doubles, Flags, Whole
from skinware.tactile.calibration.shapes import Shape, fitted
from skinware.tactile.calibration.tool import ToolErrors, compare_with_layout, regress

_ROUNDS = 5
_WRONG = 4.0  # typical residuals from which a press has no weight
_LEAST_SPREAD_M = 0.0005
_TYPICAL = 1.1774  # median of residuals in a plane, in standard deviations
_PRECISE_M = 0.0035  # spread of the points below which loads count squared, which prefers the nearest taxel
_LEAST_PRESSES = 2
_PARTS = 10  # parts of the presses that are left out in turn, for the expected error
_BIAS_M, _PRECISE_BIAS_M, _BIAS_OF_SHAPES = 0.001, 0.0004, 0.6
"""Bias of places that more presses do not lower: skins end, gains differ. Shapes leave a share of it."""


@dataclass(frozen=True)
class Placement:
    """The places of n taxels.

    Attributes:
        position_m: (n, 3), NaN: not known.
        normal: (n, 3) outwards, of length 1; NaN: not known.
        error_m: (n,) expected error along the skin, root of the mean square; NaN: not known.
        pressed: (n,) number of presses that each has felt.
        residual_m: (m,) distance of the point of each press from the centre of its taxels.
        wrong: (m,) bool, presses that were left out.
        tool: the errors of the tool that the presses show.
        tip_m: (3,) tip of the finger that pressed, in the frame of its carrier; NaN: the points were known.
    """

    position_m: Doubles
    normal: Doubles
    error_m: Doubles
    pressed: Whole
    residual_m: Doubles
    wrong: Flags
    tool: ToolErrors = field(default_factory=ToolErrors)
    tip_m: Doubles = field(default_factory=lambda: np.full(3, np.nan))

    @property
    def known(self) -> Flags:
        """(n,) bool: which places are known."""
        known: Flags = np.isfinite(self.position_m[:, 0])
        return known

    @property
    def spread_m(self) -> float:
        """Median residual of the presses that count; NaN if there is none."""
        counting = self.residual_m[~self.wrong]
        return float(np.median(counting)) if len(counting) else float("nan")

    def beneath(self, offset_m: float) -> Placement:
        """Return the places so far within, m, where these are of the points that touched.

        Raises:
            ConfigurationError: an offset without normals.
        """
        if not offset_m:
            return self
        if not np.isfinite(self.normal).all(axis=1).any():
            raise ConfigurationError(
                "an offset of the points needs the layout of modules with normals: which way is out?"
            )
        inner = self.position_m - offset_m * self.normal
        return replace(self, position_m=np.where(np.isfinite(self.normal), inner, self.position_m))


def place(
    presses: Presses,
    shapes: Mapping[int, Shape] | None = None,
    *,
    offset_m: float = 0.0,
    layout_m: Doubles | None = None,
    is_here: bool = True,
) -> Placement:
    """Find the places of the taxels, and the errors of the tool.

    Args:
        presses: presses with points.
        shapes: shapes of modules, by number; None: not known.
        offset_m: from the taxels outwards to the points: the probe's radius and the cover. It needs normals.
        layout_m: (n, 3) where a layout puts the taxels, in one coordinate frame; None: there is none.
        is_here: whether that is the coordinate frame of the points.

    Raises:
        ConfigurationError: the presses have no points; an offset without normals.
    """
    if presses.pose.ndim != 2:
        raise ConfigurationError("presses with whole poses place a finger and modules: see place_finger")
    shapes = shapes or {}
    position, _, trust, is_precise = _settled(presses, {})
    error = _errors(presses, trust, {}, is_precise, position)
    given, weight = presses, trust[presses.press] * presses.load

    def means(of: Doubles) -> Doubles:
        return _means(given, weight, of)

    def left(of: Doubles) -> Doubles:
        return of - _centres(given, means(of))

    tool, shift_m, tool_error_m = regress(given.pose, given.motions, trust, error, means, left)
    presses = replace(given, pose=given.pose - shift_m)
    position, normal, trust, is_precise = _settled(presses, shapes)
    error = np.hypot(_errors(presses, trust, shapes, is_precise, position), tool_error_m)
    residual = _residuals(presses, position)
    if layout_m is not None:
        modules = [shape.taxel for shape in shapes.values()]
        tool = compare_with_layout(tool, position, layout_m, modules, tool_error_m, is_here=is_here)
    found = Placement(position, normal, error, presses.times_pressed, residual, trust <= 0, tool)
    return found.beneath(offset_m)


def _settled(presses: Presses, shapes: Mapping[int, Shape]) -> tuple[Doubles, Doubles, Doubles, bool]:
    """(n, 3) places, (n, 3) normals, (m,) the weight of each press, and whether points are precise."""
    position = _medians(presses)
    for _ in range(_ROUNDS):
        residual = _residuals(presses, position)
        trust = _trust(residual)
        counting = residual[trust > 0]
        spread_m = float(np.median(counting)) / _TYPICAL if len(counting) else 0.0
        is_precise = max(spread_m, _LEAST_SPREAD_M) < _PRECISE_M
        position, normal = _places(presses, trust, shapes, is_precise)
    return position, normal, trust, is_precise


def _places(presses: Presses, trust: Doubles, shapes: Mapping[int, Shape], is_precise: bool) -> tuple[Doubles, Doubles]:
    """(n, 3) places, and (n, 3) normals: weighted means, and fitted shapes."""
    weight = trust[presses.press] * (presses.load**2 if is_precise else presses.load)
    position = _unbiased(presses, trust, weight) if is_precise else _means(presses, weight, presses.pose)
    normal = np.full_like(position, np.nan)
    total, squares = (np.bincount(presses.taxel, of, presses.n) for of in (weight, weight**2))
    presses_each = total**2 / np.where(squares > 0, squares, 1)  # of equal weight, that would count as much
    for shape in shapes.values():
        pose = fitted(shape, position[shape.taxel], presses_each[shape.taxel])
        if pose is not None:
            position[shape.taxel], normal[shape.taxel] = pose.places_m(shape), pose.normals(shape)
    return position, normal


def _unbiased(presses: Presses, trust: Doubles, weight: Doubles) -> Doubles:
    """(n, 3) places without the bias of the mean of a bell whose presses lie more to one side.

    The bell is as wide as the presses of a taxel typically spread; its gain does not matter.
    """
    position = _means(presses, weight, presses.pose)
    off = presses.pose[presses.press] - position[presses.taxel]
    squares = np.nan_to_num((off**2).sum(axis=1))
    each = np.bincount(presses.taxel, weight, presses.n)
    width = np.bincount(presses.taxel, weight * squares, presses.n)[each > 0] / each[each > 0]
    if not len(width):
        return position
    bell = trust[presses.press] * np.exp(-squares / max(float(np.median(width)), _LEAST_SPREAD_M**2))
    return 2 * position - _means(presses, bell, presses.pose)


def _medians(presses: Presses) -> Doubles:
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


def _residuals(presses: Presses, position: Doubles) -> Doubles:
    """(m,) distance of the point of each press from the centre of the taxels that felt it; inf without any."""
    residual = np.linalg.norm(presses.pose - _centres(presses, position), axis=1)
    return np.where(np.isnan(residual), np.inf, residual)


def _centres(presses: Presses, of: Doubles) -> Doubles:
    """(m, k) the means of (n, k) features over the taxels that felt each press, weighted by load; NaN without any."""
    known = np.isfinite(of[presses.taxel]).all(axis=1)
    press, taxel, load = presses.press[known], presses.taxel[known], presses.load[known]
    total = np.bincount(press, load, len(presses))
    sums = [np.bincount(press, load * column[taxel], len(presses)) for column in of.T]
    return np.where(total > 0, sums, np.nan).T / np.where(total > 0, total, 1)[:, None]


def _trust(residual: Doubles) -> Doubles:
    """(m,) 0 to 1: the weight of each press, by Tukey's biweight."""
    finite = residual[np.isfinite(residual)]
    if not len(finite):
        return np.zeros_like(residual)
    limit = _WRONG * max(float(np.median(finite)) / _TYPICAL, _LEAST_SPREAD_M)
    trust: Doubles = np.where(residual < limit, (1 - (np.minimum(residual, limit) / limit) ** 2) ** 2, 0.0)
    return trust


def _means(presses: Presses, weight: Doubles, of: Doubles) -> Doubles:
    """(n, k) means of (m, k) features over presses; NaN with too few presses, or felt from the side alone."""
    total = np.bincount(presses.taxel, weight, presses.n)
    count = np.bincount(presses.taxel, weight > 0, presses.n)
    sums = np.stack([np.bincount(presses.taxel, weight * column[presses.press], presses.n) for column in of.T], 1)
    enough = (total > 0) & (count >= _LEAST_PRESSES) & (presses.times_pressed > 0)
    return np.where(enough[:, None], sums / np.where(enough, total, 1)[:, None], np.nan)


def _errors(
    presses: Presses, trust: Doubles, shapes: Mapping[int, Shape], is_precise: bool, position: Doubles
) -> Doubles:
    """(n,) the expected error: the change of the places without some of the presses (jackknife), and the bias."""
    squares = []
    for left_out in range(_PARTS):
        kept = np.arange(len(presses)) % _PARTS != left_out
        without, _ = _places(presses, trust * kept, shapes, is_precise)
        squares.append(((without - position) ** 2).sum(axis=1))
    changes = np.array(squares)
    known = np.isfinite(changes).sum(axis=0)
    mean = np.nansum(changes, axis=0) / np.maximum(known, 1)
    bias_m = (_PRECISE_BIAS_M if is_precise else _BIAS_M) * (_BIAS_OF_SHAPES if shapes else 1)
    error = np.sqrt((_PARTS - 1) * mean + bias_m**2)
    return np.where(np.isfinite(position).all(axis=1) & (known > 0), error, np.nan)


@dataclass(frozen=True)
class Press:
    """One steady press.

    Attributes:
        pose: (3,) its point, m; or (4, 4) pose of the carrier of the finger, homogeneous, m.
        taxel: (k,) the taxels that feel it.
        load: (k,) their loads, above 0.
        motion: (7,) its time, s, its velocity while it rests, m/s, and the way from which it came, of length 1.
    """

    pose: Doubles
    taxel: Whole
    load: Doubles
    motion: Doubles = field(default_factory=lambda: np.full(7, np.nan))


@dataclass(frozen=True)
class Presses:
    """m presses on a skin of n taxels.

    Attributes:
        n: number of taxels.
        pose: (m, 3) or (m, 4, 4), see :class:`Press`.
        press: (k,) int64, in ascending order: the press of each pair of a press and a taxel that feels it.
        taxel: (k,) int64, its taxel.
        load: (k,) its load, above 0.
        motion: (m, 7) as of a :class:`Press`, NaN where not known; (0, 7): not known at all.

    Raises:
        ConfigurationError: the arrays do not fit each other.
    """

    n: int
    pose: Doubles
    press: Whole
    taxel: Whole
    load: Doubles
    motion: Doubles = field(default_factory=lambda: np.zeros((0, 7)))

    def __post_init__(self) -> None:
        if self.motion.shape not in ((0, 7), (len(self.pose), 7)):
            raise ConfigurationError(f"motion of {len(self.pose)} presses: give ({len(self.pose)}, 7)")
        if self.pose.ndim not in (2, 3) or self.pose.shape[1:] not in ((3,), (4, 4)):
            raise ConfigurationError(f"poses of presses: give (m, 3) or (m, 4, 4), not {self.pose.shape}")
        if not len(self.press) == len(self.taxel) == len(self.load):
            raise ConfigurationError("press, taxel and load must have one length")
        for name, of, count in (("press", self.press, len(self.pose)), ("taxel", self.taxel, self.n)):
            if len(of) and not 0 <= int(of.min()) <= int(of.max()) < count:
                raise ConfigurationError(f"{name} must count from 0 to {count - 1}")
        if not (np.isfinite(self.pose).all() and np.isfinite(self.load).all() and (self.load > 0).all()):
            raise ConfigurationError("poses must be finite, loads above 0")

    @classmethod
    def none(cls, n: int, pose_shape: tuple[int, ...] = (3,)) -> Self:
        """Make an empty set of presses on n taxels, with poses of this shape."""
        nothing = np.zeros(0, np.int64)
        return cls(n, np.zeros((0, *pose_shape)), nothing, nothing, np.zeros(0))

    @classmethod
    def of_arrays(cls, pose: npt.ArrayLike, load: npt.ArrayLike) -> Self:
        """Make presses from (m, 3) or (m, 4, 4) poses and (m, n) loads, 0 or NaN where a taxel feels nothing."""
        loads = np.asarray(load, np.float64)
        if loads.ndim != 2 or len(loads) != len(np.asarray(pose)):
            raise ConfigurationError(f"loads of presses: give a row of each pose, not {loads.shape}")
        press, taxel = np.nonzero(np.nan_to_num(loads) > 0)
        return cls(loads.shape[1], np.asarray(pose, np.float64), press, taxel, loads[press, taxel])

    def with_press(self, press: Press) -> Self:
        """Return these presses and one more."""
        return type(self)(
            self.n,
            np.concatenate([self.pose, press.pose[None]]),
            np.concatenate([self.press, np.full(len(press.taxel), len(self))]),
            np.concatenate([self.taxel, press.taxel]),
            np.concatenate([self.load, press.load]),
            np.concatenate([self.motions, press.motion[None]]),
        )

    @property
    def motions(self) -> Doubles:
        """(m, 7) the time, velocity and way of each press; NaN: not known."""
        return self.motion if len(self.motion) else np.full((len(self), 7), np.nan)

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def times_pressed(self) -> Whole:
        """(n,) number of presses that each taxel has felt at least half as much as the taxel that felt most."""
        most = np.zeros(len(self))
        np.maximum.at(most, self.press, self.load)
        return np.bincount(self.taxel[self.load >= most[self.press] / 2], minlength=self.n)
