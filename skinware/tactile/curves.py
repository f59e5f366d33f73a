"""Fit, read and apply force curves, which give values a unit of force or pressure, per type or per taxel.

The file is TOML, keyed like a geometry::

    format = "skinware-curves"
    version = 1

    [[curve]]
    type = "pressure"
    uid = [0x70500, 0x70501]    # default: all of the type that no other curve names
    from_unit = "counts"
    unit = "Pa"
    x = [0.0, 12.0, 40.0, 180.0]        # rising, at most 8
    y = [0.0, 900.0, 4500.0, 60000.0]   # not falling; beyond its ends a curve is level
    hysteresis = 0.08                   # for information: see Fit
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.toml_text import TomlText

FORMAT, VERSION = "skinware-curves", 1
MOST_KNOTS = 8

Floats = npt.NDArray[np.float32]


class Curve(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A monotone curve of straight pieces.

    Attributes:
        type: type of the sensors.
        from_unit: unit of ``x``.
        unit: unit of ``y``.
        x: 2 to 8 values, rising.
        y: their meaning, never falling.
        uid: uids of the sensors; None: all of the type that no other curve names.
        hysteresis: how far rising and falling branch are apart, as a share of the range of ``y``; None: not known.
        name: for information.

    Raises:
        ValueError: knots that are no such curve.
    """

    type: str
    from_unit: str
    unit: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    uid: tuple[Annotated[int, msgspec.Meta(ge=0)], ...] | None = None
    hysteresis: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if not 2 <= len(self.x) <= MOST_KNOTS or len(self.x) != len(self.y):
            raise ValueError(f"{len(self.x)} x and {len(self.y)} y: give as many of both, 2 to {MOST_KNOTS}")
        if not all(math.isfinite(number) for number in (*self.x, *self.y)):
            raise ValueError("a knot is not finite")
        if any(b <= a for a, b in zip(self.x, self.x[1:], strict=False)):
            raise ValueError("x must rise from knot to knot")
        if any(b < a for a, b in zip(self.y, self.y[1:], strict=False)):
            raise ValueError("y must not fall from knot to knot")


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    version: int
    curve: tuple[Curve, ...] = ()


def read_curves(path: str | Path) -> tuple[Curve, ...]:
    """Read a file of curves.

    Raises:
        ConfigurationError: not there, not TOML, not of this format, or a value that is wrong; the message says where.
    """
    text = TomlText(Path(path))
    curves = text.of_format("file of curves", FORMAT, VERSION, _File).curve
    seen: set[tuple[str, int | None]] = set()
    for number, curve in enumerate(curves):
        for uid in curve.uid if curve.uid is not None else (None,):
            if (curve.type, uid) in seen:
                what = f"uid {uid:#x}" if uid is not None else "all"
                raise ConfigurationError(f"{text.place(('curve', number))}: a second curve for {curve.type}, {what}")
            seen.add((curve.type, uid))
    return curves


class CurveTable:
    """The curves of n taxels of one type.

    Args:
        curves: all curves; those of other types are ignored.
        type_name: type of the taxels.
        uid: (n,) uids of the taxels.

    Attributes:
        unit: unit of the results.
        from_unit: unit of the values.
        minimum: (n,) float32, least result of each.
        maximum: (n,) float32, largest result of each.

    Raises:
        ConfigurationError: a taxel without a curve, or curves of several units.
    """

    def __init__(self, curves: Sequence[Curve], type_name: str, uid: npt.NDArray[np.uint64]) -> None:
        own = [curve for curve in curves if curve.type == type_name]
        units = {(curve.from_unit, curve.unit) for curve in own}
        if len(units) > 1:
            raise ConfigurationError(f"curves of {type_name} have several units: {', '.join(sorted(map(str, units)))}")
        number_of = {one: number for number, curve in enumerate(own) for one in curve.uid or ()}
        rest = next((number for number, curve in enumerate(own) if curve.uid is None), None)
        chosen = [number_of.get(int(one), rest) for one in uid.tolist()]
        if not own or None in chosen:
            without = f"uid {int(uid[chosen.index(None)]):#x}" if own else "any"
            raise ConfigurationError(f"no curve for {type_name}, {without}")
        self.from_unit, self.unit = next(iter(units))
        padding = [MOST_KNOTS - len(curve.x) for curve in own]
        padded = [
            (curve.x + curve.x[-1:] * more, curve.y + curve.y[-1:] * more)
            for curve, more in zip(own, padding, strict=True)
        ]
        knots = np.array(padded, np.float32)[np.array(chosen, np.intp)]  # (n, 2, knots)
        self._x, y = np.ascontiguousarray(knots[:, 0].T), np.ascontiguousarray(knots[:, 1].T)
        self._width = np.diff(self._x, axis=0)
        rise = np.diff(y, axis=0)
        self._slope = np.divide(rise, self._width, out=np.zeros_like(rise), where=self._width > 0)
        self.minimum: Floats = y[0]
        self.maximum: Floats = y[-1]

    def __call__(self, values: Floats) -> Floats:
        """Return (n,) the results for (n,) values; NaN stays NaN."""
        found = self.minimum.copy()
        for x, width, slope in zip(self._x, self._width, self._slope, strict=False):
            found += slope * np.clip(values - x, 0, width)
        return found


@dataclass(frozen=True)
class Fit:
    """A fitted curve.

    Attributes:
        x: knots, rising.
        y: the mean of both branches there, never falling.
        rising: the branch while the load grows; NaN without such pairs.
        falling: the branch while the load falls; NaN without such pairs.
        hysteresis: the largest distance of the branches, as a share of the range of ``y``; NaN without both.
    """

    x: npt.NDArray[np.float64]
    y: npt.NDArray[np.float64]
    rising: npt.NDArray[np.float64]
    falling: npt.NDArray[np.float64]
    hysteresis: float


def fit_curve(values: npt.ArrayLike, reference: npt.ArrayLike, knots: int = MOST_KNOTS) -> Fit:
    """Fit a monotone curve to values of a taxel and a reference, in the order of time.

    Each branch is the monotone function nearest to its pairs (pool adjacent violators), cut into pieces whose knots
    divide the values evenly by their number.

    Args:
        values: (m,) of the taxel.
        reference: (m,) of the reference, in the wanted unit.
        knots: most knots, 2 to 8.

    Raises:
        ConfigurationError: too few pairs, or values that do not vary.
    """
    pairs = np.stack([np.asarray(values, np.float64), np.asarray(reference, np.float64)])
    shown, meant = pairs[:, np.isfinite(pairs).all(axis=0)]
    if not 2 <= knots <= MOST_KNOTS:
        raise ConfigurationError(f"{knots} knots: give 2 to {MOST_KNOTS}")
    if len(shown) < knots or np.ptp(shown) == 0:
        raise ConfigurationError(f"{len(shown)} pairs: give at least {knots}, whose values vary")
    x = np.unique(np.quantile(shown, np.linspace(0, 1, knots)))
    rises = np.gradient(meant) >= 0
    rising, falling = (_branch(shown[part], meant[part], x) for part in (rises, ~rises))
    y = np.maximum.accumulate(
        np.where(np.isnan(falling), rising, np.where(np.isnan(rising), falling, (rising + falling) / 2))
    )
    span = float(y[-1] - y[0])
    apart = float(np.abs(rising - falling).max())
    return Fit(x, y, rising, falling, apart / span if span > 0 else math.nan)


def _branch(
    values: npt.NDArray[np.float64], reference: npt.NDArray[np.float64], x: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    if len(values) < 2:
        return np.full(len(x), np.nan)
    order = np.argsort(values, kind="stable")
    return np.interp(x, values[order], monotone(reference[order]))


def monotone(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return (m,) the sequence that never falls and is nearest to (m,) values, in the sum of squares."""
    means: list[float] = []
    counts: list[int] = []
    for value in values.tolist():
        mean, count = value, 1
        while means and means[-1] > mean:
            before, pooled = means.pop(), counts.pop()
            mean, count = (before * pooled + mean * count) / (pooled + count), pooled + count
        means.append(mean)
        counts.append(count)
    return np.repeat(np.array(means), counts)
