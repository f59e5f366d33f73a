"""Read and apply force curves, which give values a unit of force or pressure, per type or per taxel.

docs/tactile/baselines.md has an example of their file, which is TOML; the keys of a curve are the attributes of
:class:`Curve`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.tactile.arrays import Doubles, Floats
from skinware.tactile.baseline import UNUSABLE
from skinware.tactile.stages import Signal, Stage, StageSettings, Taxels
from skinware.toml_text import TomlText

FORMAT, VERSION = "skinware-curves", 1
MOST_KNOTS = 8
TEMPERATURE = "temperature"
"""The sensor type of temperatures."""


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
        play: of what follows the values, in ``from_unit``.
        lag: weight of its distance from them.
        creep_s: time constant of the slow values, s.
        creep: their weight.
        temperature: weight of value times kelvin above ``at_c``.
        at_c: temperature at which it has no influence, degrees Celsius.
        error: standard deviation of a result: at 0, and its growth with the result; None: not known. Those of several
            taxels add up.

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
    play: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    lag: float = 0.0
    creep_s: Annotated[float, msgspec.Meta(gt=0)] = 30.0
    creep: float = 0.0
    temperature: float = 0.0
    at_c: float = 25.0
    error: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not 2 <= len(self.x) <= MOST_KNOTS or len(self.x) != len(self.y):
            raise ValueError(f"{len(self.x)} x and {len(self.y)} y: give as many of both, 2 to {MOST_KNOTS}")
        if not all(math.isfinite(number) for number in (*self.x, *self.y)):
            raise ValueError("a knot is not finite")
        if any(b <= a for a, b in zip(self.x, self.x[1:], strict=False)):
            raise ValueError("x must rise from knot to knot")
        if any(b < a for a, b in zip(self.y, self.y[1:], strict=False)):
            raise ValueError("y must not fall from knot to knot")

    def scaled(self, gain: float, uid: tuple[int, ...]) -> Curve:
        names = ("lag", "creep", "temperature")
        terms = {name: gain * getattr(self, name) for name in names}
        return msgspec.structs.replace(self, y=tuple(gain * y for y in self.y), uid=uid, **terms)

    def toml(self) -> str:
        """Return its entry in a file."""
        given = {name: getattr(self, name) for name in self.__struct_fields__}
        own = {name: value for name, value in given.items() if value not in (None, "")}
        lists = {name: list(value) if isinstance(value, tuple) else value for name, value in own.items()}
        return "\n[[curve]]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in lists.items())


def curves_to_toml(curves: Sequence[Curve], comment: str = "") -> str:
    """Return the text of a file of curves, with a comment at its head."""
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    return f'{head}format = "{FORMAT}"\nversion = {VERSION}\n' + "".join(curve.toml() for curve in curves)


def read_curves(path: str | Path) -> tuple[Curve, ...]:
    """Read a file of curves.

    Raises:
        ConfigurationError: not there, not TOML, not of this format, or a value that is wrong; the message says where.
    """
    text = TomlText(Path(path))
    curves: tuple[Curve, ...] = text.entries("file of curves", FORMAT, VERSION, "curve", Curve)
    seen: set[tuple[str, int | None]] = set()
    for number, curve in enumerate(curves):
        for uid in curve.uid if curve.uid is not None else (None,):
            if (curve.type, uid) in seen:
                what = f"uid {uid:#x}" if uid is not None else "all"
                raise ConfigurationError(f"{text.place(('curve', number))}: a second curve for {curve.type}, {what}")
            seen.add((curve.type, uid))
    return curves


class CurveTable:
    """The curves of n taxels of one type, by their uids; curves of other types are ignored.

    Attributes:
        unit, from_unit: of the results, and of the values.
        minimum, maximum: (n,) float32, least and largest result of each.
        remembers, warms: whether results depend on values before, and on the temperature.

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
        names = ("play", "lag", "creep_s", "creep", "temperature", "at_c")
        of_curve = [[*(getattr(curve, name) for name in names), *(curve.error or (math.nan, 0.0))] for curve in own]
        of_taxel = np.array(of_curve)[np.array(chosen, np.intp)].T
        self._terms = of_taxel
        self.remembers = bool(of_taxel[[1, 3]].any())
        self.warms = bool(of_taxel[4].any())
        self._memory = LoadMemory(len(uid))

    def step(self, values: Floats, passed_s: float, temperature_c: float = math.nan) -> Floats:
        """Return (n,) the results for the next (n,) values; 0 stays 0 where the past counts.

        ``passed_s`` is the time since those before, ``temperature_c`` that of the skin; NaN: not known.
        """
        found = self(values)
        play, weight, creep_s, creep, warmth, at_c, *_ = self._terms
        if self.remembers:
            lag, slow = self._memory.step(values, passed_s, play, creep_s)
            found += (weight * lag + creep * slow).astype(np.float32)
        if self.warms and math.isfinite(temperature_c):
            found += (warmth * values * (temperature_c - at_c)).astype(np.float32)
        if self.remembers or self.warms:
            found = np.where(values > 0, np.maximum(found, 0), np.float32(0))
        return found

    def error(self, values: Floats, results: Floats) -> Floats:
        """Return (n,) standard deviations of (n,) results; NaN where not known, and beyond the knots."""
        deviation = self._terms[6] + self._terms[7] * results
        known: Floats = np.where(values <= self._x[-1], deviation, np.nan).astype(np.float32)
        return known

    def __call__(self, values: Floats) -> Floats:
        """Return (n,) what the curves alone say of (n,) values; NaN stays NaN."""
        found = self.minimum.copy()
        for x, width, slope in zip(self._x, self._width, self._slope, strict=False):
            found += slope * np.clip(values - x, 0, width)
        return found


class LoadMemory:
    """Follows the past of n taxels, as far as their force depends on it."""

    def __init__(self, n: int) -> None:
        self._follows, self._slow = np.zeros(n), np.zeros(n)

    def step(self, values: npt.NDArray[Any], passed_s: float, play: npt.ArrayLike, creep_s: npt.ArrayLike) -> Doubles:
        """Take the next (n,) values in; return (2, n): how far what follows with play is off, and the slow values."""
        self._follows = np.where(values > 0, np.clip(self._follows, values - play, values + play), 0)
        self._slow += (values - self._slow) * -np.expm1(-passed_s / np.asarray(creep_s))
        return np.array([self._follows - values, self._slow])


class CurveSettings(StageSettings, frozen=True, kw_only=True, tag="curve"):
    """Settings of curves from values to a unit of force or pressure.

    Attributes:
        file: file with the curves; a relative path starts at the folder of the chain's file.
    """

    file: str

    def stage(self, taxels: Taxels) -> CurveStage:
        table = CurveTable(read_curves(self.file), taxels.type.name, taxels.uid)
        if table.from_unit != taxels.type.unit:
            raise ConfigurationError(f"the curves are for {table.from_unit}, and the values are in {taxels.type.unit}")
        return CurveStage(taxels, table)


class CurveStage(Stage):
    """Applies the curves of n taxels.

    Attributes:
        table: the curves.
        temperature_c: of the skin in the next sample; NaN: not known.
        error: (n,) float32, standard deviations of the newest results; NaN: not known.
    """

    name = "curve"

    def __init__(self, taxels: Taxels, table: CurveTable) -> None:
        meant = replace(
            taxels.type, unit=table.unit, minimum=float(table.minimum.min()), maximum=float(table.maximum.max())
        )
        super().__init__(replace(taxels, type=meant, resolution=0.0))
        self.table = table
        self.temperature_c = math.nan
        self.error: Floats = np.full(len(taxels), np.nan, np.float32)

    def step(self, signal: Signal) -> None:
        found = self.table.step(signal.values, self._passed_s(signal), self.temperature_c)
        self.error = self.table.error(signal.values, found)
        signal.values[:] = found


def temperature_of(frame: DriverSnapshot) -> float:
    """Return the mean of the temperatures that a driver measures, degrees Celsius; NaN: none."""
    if TEMPERATURE not in [sensor_type.name for sensor_type in frame.structure.types]:
        return math.nan
    usable = (frame.status_of(TEMPERATURE) & UNUSABLE) == 0
    return float(np.mean(frame.physical(TEMPERATURE)[usable])) if usable.any() else math.nan
