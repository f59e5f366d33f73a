"""Find the errors of the tool whose points place taxels, by one regression of the residuals of its presses.

The residual of a press is the way from the centre of the taxels that felt it to its point. Points that drift, that lag
behind the skin or that depend on the direction from which they come leave residuals that follow time, velocity or
direction. The places of the taxels take up a part of all three, which the features lose as the residuals did.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from skinware.tactile.arrays import Doubles, Whole
from skinware.tactile.calibration.shapes import rigid

Smoother = Callable[[Doubles], Doubles]

DRIFT, LAG, PLAY, SCALE, OFFSET = "drift", "lag", "play", "scale", "offset"
KINDS = (DRIFT, LAG, PLAY, SCALE, OFFSET)

_SURE = 4.0  # standard errors from which an error of the tool is reported
_INFLATION = 1.25  # times a standard error: presses beside each other share the errors of their taxels
_LEAST_M = 0.0003  # effect on a point below which no error of the tool is reported, m
_KNOTS, _PRESSES_A_KNOT = 6, 60  # pieces of a drift that is not even, and presses that each needs
_FINER = 3
_UNEVEN = 3.0  # times the spread by chance: what finer pieces may explain of the residuals without any reason
_ROUNDS = 3
_LEAST_REST = 0.01  # share of a feature that places of taxels must leave, or it is one with them
_FEWEST = 30
_LEAST_MODULES = 4
_MM, _MINUTE_S = 1e3, 60.0


@dataclass(frozen=True)
class ToolErrors:
    """The errors of a tool, as far as presses show them, in words.

    Attributes:
        found, doubts: errors that were found and corrected, and those that cannot be; without doubts places can be
            trusted.
        unchecked: errors that would not show: by how much each may move the places, m; infinite: by any way.
    """

    found: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    unchecked: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(KINDS, math.inf))

    def words(self) -> list[str]:
        """Return all of it, a line each."""
        lines = [f"corrected: {one}" for one in self.found] + [f"not trustworthy: {one}" for one in self.doubts]
        open_m = ", ".join(
            f"{kind} of any size" if math.isinf(most_m) else f"{kind} of up to {_MM * most_m:.1f} mm"
            for kind, most_m in self.unchecked.items()
        )
        return [*lines, f"would not show: {open_m}"] if open_m else lines


def regress(
    point_m: Doubles, motion: Doubles, trust: Doubles, error_m: Doubles, means: Smoother, left: Smoother
) -> tuple[ToolErrors, Doubles, Doubles]:
    """Find drift, lag and play.

    Args:
        point_m, motion, trust: (m, ...) points of m presses, their motion as of a :class:`.placing.Press`, and weights.
        error_m: (n,) error of the places by chance; an error of the tool that is less certain is left alone.
        means: makes (n, k) of (m, k): the means of presses over the taxels that felt them.
        left: makes (m, k) of (m, k): how they differ from the centre of those means.

    Returns:
        The errors, (m, 3) m by which each point is off as far as it was found, and (n,) m the standard error of that in
        the places.
    """
    counting = trust > 0
    most_m = float(np.nanmedian(error_m)) if np.isfinite(error_m).any() else 0.0
    nothing = ToolErrors(), np.zeros_like(point_m), np.zeros(len(error_m))
    if counting.sum() < _FEWEST:
        return nothing
    residual, time_s = left(point_m), motion[:, 0]
    terms = {DRIFT: _pieces(time_s, 1), LAG: motion[None, :, 1:4], PLAY: motion[None, :, 4:]}
    terms = {kind: of for kind, of in terms.items() if np.isfinite(of[:, counting]).all(axis=(0, 2)).mean() > 0.5}
    terms = {kind: np.nan_to_num(of) for kind, of in terms.items()}
    rest = {kind: np.nan_to_num([left(feature) for feature in of]) for kind, of in terms.items()}
    terms = {kind: of for kind, of in terms.items() if (rest[kind] ** 2).sum() > _LEAST_REST**2 * (of**2).sum()}
    if not terms:
        return nothing
    fit = _Fit.of(terms, residual, trust, left)
    doubts: list[str] = []
    knots = int(counting.sum()) // _PRESSES_A_KNOT
    if DRIFT in terms and knots >= 2:
        for pieces in (min(_KNOTS, knots), min(_KNOTS * _FINER, knots)):
            finer = _Fit.of({**terms, DRIFT: _pieces(time_s, pieces)}, residual, trust, left)
            if not finer.is_better_than(fit):
                break
            fit = finer
        else:
            if pieces > _KNOTS:
                doubts.append(
                    "the tool moves to and fro too quickly to be followed: fasten it, or look at its tracking"
                )
    return _concluded(fit, time_s, most_m, means, doubts)


def _pieces(time_s: Doubles, pieces: int) -> Doubles:
    """(3 * pieces, m, 3): a line of even pieces over time, from 0 at the first press, in each axis."""
    known = time_s[np.isfinite(time_s)]
    if not len(known):
        return np.full((3, len(time_s), 3), np.nan)
    knots = np.linspace(known.min(), known.max(), pieces + 1)
    hats = np.array([np.interp(time_s, knots, of) for of in np.eye(pieces + 1)[1:]])
    found: Doubles = (hats[:, None, :, None] * np.eye(3)[None, :, None, :]).reshape(-1, len(time_s), 3)
    return found


@dataclass(frozen=True)
class _Fit:
    """A robust least-squares fit of terms (p, m, 3) to residuals (m, 3)."""

    terms: dict[str, Doubles]
    weights: Doubles
    covariance: Doubles
    cost: float  # mean square of what is left, in each axis, m^2
    counting: float

    @classmethod
    def of(cls, terms: dict[str, Doubles], residual: Doubles, trust: Doubles, left: Smoother) -> _Fit:
        features = np.array([np.nan_to_num(left(feature)) for term in terms.values() for feature in term])
        residual = np.nan_to_num(residual)
        size = np.maximum(np.sqrt((features**2).mean(axis=(1, 2))), 1e-9)
        features /= size[:, None, None]
        flat, trust = features.reshape(len(features), -1), trust * 1.0
        for _ in range(_ROUNDS):
            weighted = flat * np.repeat(trust, 3)
            matrix = weighted @ flat.T + 1e-6 * trust.sum() * np.eye(len(flat))
            found = np.linalg.solve(matrix, weighted @ residual.reshape(-1))
            off = residual - (found @ flat).reshape(-1, 3)
            squares = (off**2).sum(axis=1)
            limit = 16 * max(float(np.median(squares[trust > 0])) / 1.39, 1e-8)
            trust = np.where(trust > 0, np.maximum(1 - squares / limit, 1e-9) ** 2, 0)
        of_press = (features * (trust[:, None] * off)).sum(axis=2)
        inverse = np.linalg.inv(matrix)
        covariance = _INFLATION**2 * inverse @ (of_press @ of_press.T) @ inverse / np.outer(size, size)
        return cls(terms, found / size, covariance, float((trust * squares).sum()), float(trust.sum()))

    def is_better_than(self, other: _Fit) -> bool:
        """Whether this one, with more weights, leaves less than chance would."""
        more = len(self.weights) - len(other.weights)
        spread = self.cost / (3 * self.counting)
        gained = other.cost * self.counting / other.counting - self.cost
        return more > 0 and gained > spread * (more + _UNEVEN * math.sqrt(2 * more)) * _INFLATION


def _concluded(
    fit: _Fit, time_s: Doubles, most_m: float, means: Smoother, doubts: list[str]
) -> tuple[ToolErrors, Doubles, Doubles]:
    shift: Doubles = np.zeros((len(time_s), 3))
    error2 = 0.0 * means(shift)[:, 0]
    found: list[str] = []
    unchecked = dict.fromkeys(KINDS, math.inf)
    first = 0
    for kind, features in fit.terms.items():
        rows = slice(first, first + len(features))
        weights, covariance, first = fit.weights[rows], fit.covariance[rows, rows], rows.stop
        of_taxel = np.array([means(feature) for feature in features])  # (p, n, 3)
        each2 = np.einsum("pni,pq,qni->n", of_taxel, covariance, of_taxel)
        typical_m = float(np.sqrt(np.nanmedian(each2)))
        effect = np.tensordot(weights, features, 1)
        most_of_it_m = float(np.sqrt((effect**2).sum(axis=1)).max())
        sure = float(weights @ np.linalg.solve(covariance, weights)) - len(weights)
        is_found = sure > _SURE**2 * math.sqrt(len(weights)) and most_of_it_m > _LEAST_M
        if not is_found and typical_m > most_m:
            unchecked[kind] = _SURE * typical_m
            continue
        del unchecked[kind]
        shift, error2 = shift + effect, error2 + each2
        if is_found:
            found.append(_words(kind, weights, effect, time_s, most_of_it_m))
    return ToolErrors(tuple(found), tuple(doubts), unchecked), shift, np.sqrt(np.nan_to_num(error2))


def _words(kind: str, weights: Doubles, effect: Doubles, time_s: Doubles, most_m: float) -> str:
    if kind == LAG:
        return f"the points lag {-float(weights[0]):.2f} s behind the skin: take the times of both from one clock"
    if kind == PLAY:
        play_mm = 2 * _MM * abs(float(weights[0]))
        return f"the points differ by {play_mm:.1f} mm with the way from which the tool comes: it has play"
    minutes = float(np.nanmax(time_s) - np.nanmin(time_s)) / _MINUTE_S
    end = ", ".join(f"{_MM * number:.1f}" for number in effect[np.nanargmax(time_s)].tolist())
    return (
        f"the tool drifts: {_MM * most_m:.1f} mm in {minutes:.0f} min, at the end ({end}) mm,"
        f" {_MM * most_m / max(minutes, 1e-9):.1f} mm/min: let it warm up, or set its zero again between presses"
    )


def compare_with_layout(
    tool: ToolErrors,
    position_m: Doubles,
    layout_m: Doubles,
    modules: Iterable[Whole],
    error_m: Doubles,
    *,
    is_here: bool,
) -> ToolErrors:
    """Return what is known of the tool, with its scale and offset by a layout.

    Args:
        tool: the errors that are known.
        position_m, layout_m: (n, 3) places, and those of the layout, in one coordinate frame; NaN where it has none.
        modules: the taxels of each module: modules are compared as a whole.
        error_m: (n,) standard error of all places together by the corrections.
        is_here: whether the layout is in the coordinate frame of the points.
    """
    whole = [taxels for taxels in modules if np.isfinite(position_m[taxels] + layout_m[taxels]).all()]
    if len(whole) < _LEAST_MODULES:
        return tool
    said, measured = (np.array([of[taxels].mean(axis=0) for taxels in whole]) for of in (layout_m, position_m))
    weight = np.ones(len(said))
    for _ in range(_ROUNDS):
        pose = rigid(said, measured, weight)
        middle = np.average(measured, axis=0, weights=weight)
        arm = (said - np.average(said, axis=0, weights=weight)) @ pose.rotation.T
        squares = weight[:, None] * arm
        scale = float((squares * (measured - middle)).sum() / (squares * arm).sum())
        rest = np.linalg.norm(measured - middle - scale * arm, axis=1)
        weight = 1 / (1 + (rest / max(float(np.median(rest)), _LEAST_M / 4)) ** 2)
    by_chance = float(np.sqrt(np.average(rest**2, weights=weight) / len(rest)))
    least_m = max(_SURE * math.hypot(by_chance, float(np.median(error_m))), _LEAST_M)
    offset = np.average(measured - said, axis=0, weights=weight)
    unchecked = {**tool.unchecked, SCALE: least_m} | ({OFFSET: least_m} if is_here else {})
    doubts = list(tool.doubts)
    if abs(scale - 1) * float(np.sqrt((arm**2).sum(axis=1).mean())) > least_m:
        doubts.append(f"the skin is {scale:.3f} times as large as in the layout: check the unit, and the robot's model")
        del unchecked[SCALE]
        unchecked[OFFSET] = math.inf
    elif is_here and float(np.linalg.norm(offset)) > least_m:
        by = ", ".join(f"{_MM * number:.1f}" for number in offset.tolist())
        doubts.append(
            f"all places are ({by}) mm from the layout: the zero of the tool is off, or the skin is elsewhere"
        )
        del unchecked[OFFSET]
    return ToolErrors(tool.found, tuple(doubts), unchecked)
