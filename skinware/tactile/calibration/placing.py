"""Place taxels from presses at known points: each at the mean of its presses, weighted by its load."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware.tactile.calibration.shapes import Shape, fitted

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]

_ROUNDS = 5
_WRONG = 4.0
"""Typical residuals from which a press has no weight."""
_LEAST_SPREAD_M = 0.0005
_TYPICAL = 1.1774
"""Median of residuals in a plane, in standard deviations."""
_PRECISE_M = 0.0035
"""Spread of the points below which loads count squared, which prefers the nearest taxel."""
_LEAST_PRESSES = 2
_PARTS = 10
"""Parts of the presses that are left out in turn, for the expected error."""
_BIAS_M, _PRECISE_BIAS_M = 0.001, 0.0003
"""Bias of places that more presses do not lower: skins end, gains differ."""


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
    """

    position_m: ArrayF
    normal: ArrayF
    error_m: ArrayF
    pressed: ArrayI
    residual_m: ArrayF
    wrong: npt.NDArray[np.bool_]

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: which places are known."""
        known: npt.NDArray[np.bool_] = np.isfinite(self.position_m[:, 0])
        return known

    @property
    def spread_m(self) -> float:
        """Median residual of the presses that count; NaN if there is none."""
        counting = self.residual_m[~self.wrong]
        return float(np.median(counting)) if len(counting) else float("nan")


def place(presses: Presses, shapes: Mapping[int, Shape] | None = None, *, offset_m: float = 0.0) -> Placement:
    """Find the places of the taxels.

    Args:
        presses: presses with points.
        shapes: shapes of modules, by number; None: not known.
        offset_m: from the taxels outwards to the points: the probe's radius and the cover. It needs normals.

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
    """(n, 3) places, and (n, 3) normals: weighted means, and fitted shapes."""
    weight = trust[presses.press] * (presses.load**2 if is_precise else presses.load)
    position = _means(presses, weight)
    if is_precise:
        position = _unbiased(presses, trust, weight, position)
    normal = np.full_like(position, np.nan)
    total, squares = (np.bincount(presses.taxel, of, presses.n) for of in (weight, weight**2))
    presses_each = total**2 / np.where(squares > 0, squares, 1)  # of equal weight, that would count as much
    for shape in shapes.values():
        pose = fitted(shape, position[shape.taxel], presses_each[shape.taxel])
        if pose is not None:
            position[shape.taxel], normal[shape.taxel] = pose.places_m(shape), pose.normals(shape)
    return position, normal


def _unbiased(presses: Presses, trust: ArrayF, weight: ArrayF, position: ArrayF) -> ArrayF:
    """(n, 3) places without the bias of the mean of a bell whose presses lie more to one side.

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
    """(m,) distance of the point of each press from the centre of the taxels that felt it; inf without any."""
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
    """(n, 3) the weighted means of the points; NaN with too few presses, or felt from the side alone."""
    total = np.bincount(presses.taxel, weight, presses.n)
    count = np.bincount(presses.taxel, weight > 0, presses.n)
    points = presses.pose[presses.press]
    sums = np.stack([np.bincount(presses.taxel, weight * points[:, axis], presses.n) for axis in range(3)], 1)
    enough = (total > 0) & (count >= _LEAST_PRESSES) & (presses.times_pressed > 0)
    return np.where(enough[:, None], sums / np.where(enough, total, 1)[:, None], np.nan)


def _errors(presses: Presses, trust: ArrayF, shapes: Mapping[int, Shape], is_precise: bool, position: ArrayF) -> ArrayF:
    """(n,) the expected error: the change of the places without some of the presses (jackknife), and the bias."""
    squares = []
    for left_out in range(_PARTS):
        kept = np.arange(len(presses)) % _PARTS != left_out
        without, _ = _places(presses, trust * kept, shapes, is_precise)
        squares.append(((without - position) ** 2).sum(axis=1))
    changes = np.array(squares)
    known = np.isfinite(changes).sum(axis=0)
    mean = np.nansum(changes, axis=0) / np.maximum(known, 1)
    error = np.sqrt((_PARTS - 1) * mean + (_PRECISE_BIAS_M if is_precise else _BIAS_M) ** 2)
    return np.where(np.isfinite(position).all(axis=1) & (known > 0), error, np.nan)


@dataclass(frozen=True)
class Press:
    """One steady press.

    Attributes:
        pose: (3,) its point, m; or (4, 4) pose of the carrier of the finger, homogeneous, m.
        taxel: (k,) the taxels that feel it.
        load: (k,) their loads, above 0.
    """

    pose: ArrayF
    taxel: ArrayI
    load: ArrayF


@dataclass(frozen=True)
class Presses:
    """m presses on a skin of n taxels.

    Attributes:
        n: number of taxels.
        pose: (m, 3) or (m, 4, 4), see :class:`Press`.
        press: (k,) int64, in ascending order: the press of each pair of a press and a taxel that feels it.
        taxel: (k,) int64, its taxel.
        load: (k,) its load, above 0.

    Raises:
        ConfigurationError: the arrays do not fit each other.
    """

    n: int
    pose: ArrayF
    press: ArrayI
    taxel: ArrayI
    load: ArrayF

    def __post_init__(self) -> None:
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
        """Make an empty set of presses on n taxels; ``pose_shape`` is the shape of a pose."""
        nothing = np.zeros(0, np.int64)
        return cls(n, np.zeros((0, *pose_shape)), nothing, nothing, np.zeros(0))

    @classmethod
    def of_arrays(cls, pose: npt.ArrayLike, load: npt.ArrayLike) -> Self:
        """Make presses from whole arrays.

        Args:
            pose: (m, 3) or (m, 4, 4).
            load: (m, n), 0 or NaN where a taxel feels nothing.
        """
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
        )

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def times_pressed(self) -> ArrayI:
        """(n,) number of presses that each taxel has felt at least half as much as the taxel that felt most."""
        most = np.zeros(len(self))
        np.maximum.at(most, self.press, self.load)
        return np.bincount(self.taxel[self.load >= most[self.press] / 2], minlength=self.n)


@dataclass(frozen=True, kw_only=True)
class PressSettings:
    """The conditions of a steady press.

    Attributes:
        hold_s: how long it lasts.
        steady: share by which its load may change meanwhile.
        still_m: how far its point may move meanwhile, m.
    """

    hold_s: float = 0.2
    steady: float = 0.3
    still_m: float = 0.002


@dataclass
class PressFinder:
    """Finds presses in frames: one each time that something comes to rest on the skin.

    Attributes:
        settings: the conditions of a press.
        held: whether the last press that was found still goes on.
    """

    settings: PressSettings = field(default_factory=PressSettings)
    held: bool = False
    _window: list[tuple[int, ArrayF, ArrayF]] = field(default_factory=list)
    _found_at_m: ArrayF = field(default_factory=lambda: np.full(3, np.nan))

    def update(self, time_ns: int, load: npt.NDArray[Any], pose: ArrayF | None) -> Press | None:
        """Take a frame, and return the press that is complete with it.

        Args:
            time_ns: of the frame.
            load: (n,) 0 where nothing touches, NaN where it is not known.
            pose: (3,) or (4, 4), at that time; None or not finite: not known.
        """
        loads = np.nan_to_num(np.asarray(load, np.float64), posinf=0.0)
        total = float(loads.sum())
        if pose is None or not np.isfinite(pose).all() or total <= 0:
            self._window.clear()
            self.held = self.held and total > 0
            return None
        settings = self.settings
        if self._window:
            _, first_load, first_pose = self._window[0]
            first = float(first_load.sum())
            is_steady = abs(total - first) <= settings.steady * max(total, first)
            if not is_steady or np.linalg.norm(_point(pose) - _point(first_pose)) > settings.still_m:
                self._window.clear()
        if self.held and np.linalg.norm(_point(pose) - _point(self._found_at_m)) > 2 * settings.still_m:
            self.held = False
        self._window.append((time_ns, loads, np.array(pose, np.float64)))
        if self.held or time_ns - self._window[0][0] < settings.hold_s * NS_PER_S:
            if self.held:
                del self._window[:-1]
            return None
        mean = np.mean([each for _, each, _ in self._window], axis=0)
        at = np.mean([each for _, _, each in self._window], axis=0)
        at = self._window[-1][2] if at.ndim == 2 else at  # rotations have no mean
        self._window.clear()
        self.held, self._found_at_m = True, at
        taxel = np.flatnonzero(mean > 0)
        return Press(at, taxel, mean[taxel])


def _point(pose: ArrayF) -> ArrayF:
    """(3,) the point, or the origin of the pose."""
    point: ArrayF = pose if pose.ndim == 1 else pose[:3, 3]
    return point
