"""Take taxels with three axes for what they are: vectors, which a field of the world moves together while a hand turns.

Both stages work on all three axes of some taxels at once. ``field``, before the baselines, takes off the field that all
taxels of a rigid array feel. ``vector``, behind the baselines, shows all axes of a taxel where one of them is touched.
``skinware/native/field.c`` computes the field, docs/tactile/turning.md has its formulas.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.errors import ConfigurationError
from skinware.native import give_arrays, read_structs
from skinware.tactile.arrays import Doubles, Flags, Floats
from skinware.tactile.baseline import FORGET_AFTER_S
from skinware.tactile.stages import Positive, Signal, Stage, StageSettings, Taxels

AXES = (
    ("magnetic_field_x", "magnetic_field_y", "magnetic_field_z"),
    ("shear_x", "shear_y", "pressure"),
    *((f"{of}_x", f"{of}_y", f"{of}_z") for of in ("force", "resultant", "total_force")),
)
"""Types that are the axes of one vector, where they have the same taxels."""
LEAST_ARRAY = 4
"""Taxels of a patch that it takes to know a touch from a field."""

_STRUCTS = read_structs([Path(native.__file__).with_name("field.h")])
_NUMBERS = {"response": 12, "covariance": 16, "load": 3, "rest": 3}  # numbers of a taxel, where there are several

_update = native.core().quick.skinware_field_update
_update.argtypes, _update.restype = (*(ctypes.c_void_p,) * 3, ctypes.c_double, ctypes.c_void_p), None


def vectors_of(taxels: Mapping[str, Taxels]) -> list[tuple[str, ...]]:
    """The types that are axes of the same taxels, among those of a driver by name."""
    return [
        names
        for names in AXES
        if all(name in taxels and np.array_equal(taxels[name].uid, taxels[names[0]].uid) for name in names)
        and len({taxels[name].type.unit for name in names}) == 1
    ]


class ArrayField:
    """Follows a uniform field, and how each of n three-axis taxels responds to it.

    Neighbouring taxels of one patch are a rigid array. ``spread`` is the standard deviation of the responses around 1.
    """

    def __init__(self, patch: npt.NDArray[np.integer], spread: float) -> None:
        n = len(patch)
        starts = np.flatnonzero(np.diff(patch, prepend=-1))
        ends = np.append(starts[1:], n)
        rigid = np.flatnonzero(ends - starts >= LEAST_ARRAY)
        self._n, self._memory = n, (_STRUCTS["Array"] * len(rigid))()
        for array, run in zip(self._memory, rigid, strict=True):
            array.first, array.last = starts[run], ends[run]
        self._words = words = _STRUCTS["Field"]()
        words.n, words.n_arrays, words.arrays = n, len(rigid), ctypes.addressof(self._memory)
        words.spread2, words.forget_after_s = spread**2, FORGET_AFTER_S
        self._arrays = give_arrays(words, n, {name: numbers * n for name, numbers in _NUMBERS.items()})
        self._arrays["away_s"][:] = np.inf
        self._at = ctypes.addressof(words)

    def __len__(self) -> int:
        return len(self._memory)

    @property
    def now(self) -> Doubles:
        """(arrays, 3) the change of the field at each array since its first sample; a copy."""
        return np.array([list(array.field) for array in self._memory]).reshape(-1, 3)

    @property
    def bears(self) -> Flags:
        """(n,) bool, which taxels bear a load in the newest sample; a copy."""
        bears: Flags = self._arrays["bears"].copy()
        return bears

    def update(self, values: Floats, usable: Flags, passed_s: float) -> tuple[Floats, Flags]:
        """Take in (3, n) float32 values, (n,) bool usable, and the seconds since the sample before.

        Returns:
            (3, n) float32, the values without level and field; and (n,) bool, which of them are certain enough to say
            whether something touches.
        """
        given, sure = np.ascontiguousarray(values, np.float32), np.array(usable, np.bool_)
        rest = given.copy()
        _update(self._at, given.ctypes.data, sure.ctypes.data, passed_s, rest.ctypes.data)
        return rest, sure


class FieldSettings(StageSettings, frozen=True, kw_only=True, tag="field"):
    """Settings of the field that all three-axis taxels of a patch feel while it turns.

    Attributes:
        spread: standard deviation of the gains of the taxels, and of the angles between their axes in radians.
    """

    spread: Positive = 0.1

    def stage(self, *axes: Taxels) -> Stage:
        stage = FieldStage(axes, self.spread)
        if not len(stage.field):
            raise ConfigurationError(f"no patch has {LEAST_ARRAY} taxels of {axes[0].type.name}")
        return stage


class FieldStage(Stage):
    """Takes level and field off the three axes of n taxels."""

    name = "field"

    def __init__(self, axes: tuple[Taxels, ...], spread: float) -> None:
        spans = [one.type.maximum - one.type.minimum for one in axes]
        of_both_signs = (
            replace(one, type=replace(one.type, minimum=-span, maximum=span), resolution=0.0, signed=True, common=False)
            for one, span in zip(axes, spans, strict=True)
        )
        super().__init__(*of_both_signs)
        self.field = ArrayField(axes[0].patch, spread)

    def step(self, signal: Signal, *others: Signal) -> None:
        signals = (signal, *others)
        usable = np.logical_and.reduce([one.usable for one in signals])
        rest, sure = self.field.update(np.array([one.values for one in signals]), usable, self._passed_s(signal))
        for one, values in zip(signals, rest, strict=True):
            one.values[:], one.usable[:], one.bears[:] = values, sure, self.field.bears


class VectorSettings(StageSettings, frozen=True, kw_only=True, tag="vector"):
    """Settings of vectors: all axes of a taxel are touched where one is."""

    def stage(self, *axes: Taxels) -> Stage:
        return VectorStage(*axes)


class VectorStage(Stage):
    """Shows how far all three axes of a taxel are from their baselines where one of them is touched."""

    name = "vector"

    def step(self, signal: Signal, *others: Signal) -> None:
        signals = (signal, *others)
        touched = np.logical_or.reduce([one.values != 0 for one in signals])
        for one in signals:
            one.values[:] = np.where(touched & np.isfinite(one.deviation), one.deviation, np.float32(0))
