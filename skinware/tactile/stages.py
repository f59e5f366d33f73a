"""Filter, scale and amplify the values of n taxels of one type, sample by sample: the stages of a chain.

Each can be used alone: make it from its settings with ``stage(taxels)``, and change a :class:`Signal` with ``step``.
The settings of a stage are also its entry in the file of a chain.
"""

from __future__ import annotations

import ctypes
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import msgspec
import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.errors import ConfigurationError
from skinware.native import give_arrays, read_structs
from skinware.realtime import NS_PER_S
from skinware.sensor_types import SensorType
from skinware.structure import Structure
from skinware.tactile.arrays import Doubles, Flags, Floats, Whole
from skinware.tactile.baseline import SIGNED_TYPES, resolution_of

NO_UNIT = "1"
"""Unit of values that are no quantity any more."""


STRUCTS = read_structs([Path(native.__file__).with_name("chain.h")])
"""The structs of chain.h."""


class Signal:
    """One sample of n taxels on its way through stages, which change its arrays in place.

    ``index`` is (n,) where they stand in a snapshot.

    Attributes:
        time_ns: time of the sample.
        values: (n,) float32.
        usable: (n,) bool, which values are of this sample.
        jumped: (n,) bool, where the hardware moved its own baseline just before it.
        forced: (n,) bool, where a stage moved a baseline by force.
        bears: (n,) bool, where the vector of which a value is an axis bears a load.
        unknown: (n,) bool, where a stage has no result yet; the value is 0.
        deviation: (n,) float32, how far a baseline found the values from it, touched or not; before that, the values.
        at: address of its ``struct signal``, for C.
    """

    def __init__(self, index: npt.ArrayLike) -> None:
        words, given = STRUCTS["Signal"](), np.array(index, np.int64)
        words.n = len(given)
        self.time_ns = 0
        self._kept = words, give_arrays(words, len(given), {}, {"index": given})
        arrays = self._kept[1]
        self.values: Floats = arrays["values"]
        self.deviation: Floats = arrays["deviation"]
        self.usable: Flags = arrays["usable"]
        self.jumped: Flags = arrays["jumped"]
        self.forced: Flags = arrays["forced"]
        self.unknown: Flags = arrays["unknown"]
        self.bears: Flags = arrays["bears"]
        self.at: int = ctypes.addressof(words)

    @classmethod
    def of(cls, time_ns: int, values: npt.ArrayLike, usable: npt.ArrayLike | None = None) -> Self:
        """Make a signal of (n,) values; default of ``usable``: all finite ones."""
        taken = np.array(values, np.float32)
        signal = cls(np.arange(len(taken)))
        signal.time_ns = time_ns
        signal.values[:], signal.deviation[:] = taken, taken
        signal.usable[:] = np.isfinite(taken) if usable is None else np.isfinite(taken) & usable
        return signal


@dataclass(frozen=True, eq=False)
class Taxels:
    """The n taxels of one type that a stage is made for.

    Attributes:
        type: the type as the stage gets it: unit and range of its values.
        uid: (n,) uids.
        module: (n,) their modules.
        patch: (n,) their patches.
        resolution: step of the values; 0 if they have none.
        signed: a touch may move a value to both sides.
        common: the taxels of a patch may drift together.
    """

    type: SensorType
    uid: npt.NDArray[np.uint64]
    module: Whole
    patch: Whole
    resolution: float = 0.0
    signed: bool = False
    common: bool = True

    @classmethod
    def of(cls, structure: Structure, type_name: str) -> Taxels:
        """Return the taxels of a type of a driver; raises StructureError if it has no such type."""
        sensor_type = structure.type(type_name)
        return cls(
            sensor_type,
            structure.sensor_uid[structure.index(type_name)],
            structure.module_of(type_name),
            structure.patch_of(type_name),
            resolution_of(structure, type_name),
            type_name.startswith(SIGNED_TYPES),
        )

    def __len__(self) -> int:
        return len(self.uid)


class Stage(ABC):
    """A step that changes signals.

    Attributes:
        name: its name in files.
        axes: the taxels as they come out, for each type that the stage changes together.
        taxels: those of the first type.
    """

    name: ClassVar[str]

    def __init__(self, *axes: Taxels) -> None:
        self.axes, self.taxels = axes, axes[0]
        self._time_ns: int | None = None

    def _passed_s(self, signal: Signal) -> float:
        """The seconds since the sample before; 0 for the first."""
        before_ns, self._time_ns = self._time_ns, signal.time_ns
        return 0.0 if before_ns is None else max(0, signal.time_ns - before_ns) / NS_PER_S

    def state(self) -> dict[str, Doubles]:
        """Return what baselines behind it need after a restart: arrays (n,) by name, copies."""
        return {}

    def restore(  # noqa: B027
        self, state: Mapping[str, Doubles], rows: npt.NDArray[np.integer]
    ) -> None:
        """Go on with the state of another stage: (n,) ``rows`` say where each taxel stands there; -1: nowhere.

        Raises:
            ConfigurationError: that is no such state.
        """

    @abstractmethod
    def step(self, signal: Signal) -> None:
        """Change one sample in place, of each type where it is for several; samples come in order of time."""


class StageSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="stage"):
    """Settings of a stage. Each has a method ``stage`` that makes it for some taxels.

    That raises ConfigurationError where it cannot be made; the message says why.

    Attributes:
        types: the sensor types that it is for; None: all for which it can be made.
    """

    types: tuple[str, ...] | None = None


Positive = Annotated[float, msgspec.Meta(gt=0)]


class FilterSettings(StageSettings, frozen=True, kw_only=True, tag="filter"):
    """Settings of a filter that smooths each taxel over time; the unit stays.

    Attributes:
        method: ``lowpass`` of first order, ``mean`` or ``median`` of the last samples.
        tau_s: time constant of ``lowpass``, s.
        frames: number of samples for ``mean`` and ``median``, 2 to 99.
    """

    method: Literal["lowpass", "mean", "median"] = "lowpass"
    tau_s: Positive = 0.1
    frames: Annotated[int, msgspec.Meta(ge=2, le=99)] = 3

    def stage(self, taxels: Taxels) -> Stage:
        return Lowpass(taxels, self.tau_s) if self.method == "lowpass" else LastFrames(taxels, self.frames, self.method)


class Lowpass(Stage):
    """Smooths n taxels by a low-pass of first order, by the time that passes."""

    name = "filter"

    def __init__(self, taxels: Taxels, tau_s: float) -> None:
        super().__init__(replace(taxels, resolution=0.0))
        self._tau_s = tau_s
        self._smooth: Floats = np.full(len(taxels), np.nan, np.float32)

    def step(self, signal: Signal) -> None:
        share = np.float32(-math.expm1(-self._passed_s(signal) / self._tau_s))
        np.copyto(self._smooth, signal.values, where=signal.usable & np.isnan(self._smooth))
        self._smooth += np.where(signal.usable, signal.values - self._smooth, np.float32(0)) * share
        signal.values[:] = np.where(np.isnan(self._smooth), signal.values, self._smooth)


class LastFrames(Stage):
    """Replaces the values of n taxels by the mean or median of their last usable ones."""

    name = "filter"

    def __init__(self, taxels: Taxels, frames: int, method: Literal["mean", "median"]) -> None:
        super().__init__(replace(taxels, resolution=0.0))
        self._median = method == "median"
        self._last: Floats = np.full((frames, len(taxels)), np.nan, np.float32)

    def step(self, signal: Signal) -> None:
        new = signal.usable & np.isnan(self._last[0])
        self._last[:, new] = signal.values[new]
        self._last = np.roll(self._last, -1, axis=0)
        self._last[-1] = np.where(signal.usable, signal.values, self._last[-2])
        ordered = np.sort(self._last, axis=0) if self._median else self._last
        if self._median:
            middle = len(ordered) // 2
            found = ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2
        else:
            found = ordered.mean(axis=0)
        signal.values[:] = np.where(np.isnan(found), signal.values, found)


class ScalerSettings(StageSettings, frozen=True, kw_only=True, tag="scaler"):
    """Settings of a scaler that gives each taxel the same range; the result has no unit.

    Attributes:
        source: ``range``: the range of the type; ``seen``: the range that each taxel has shown so far.
        low: least value of the result.
        high: largest value of the result.
        shrink_s: the seen range shrinks towards the present value with this time constant, s; None: never.
    """

    source: Literal["range", "seen"] = "range"
    low: float = 0.0
    high: float = 1.0
    shrink_s: Positive | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.high - self.low) or self.low >= self.high:
            raise ConfigurationError(f"low = {self.low}, high = {self.high}: give a range")

    def stage(self, taxels: Taxels) -> Stage:
        span = taxels.type.maximum - taxels.type.minimum
        if self.source == "range" and not 0 < span < math.inf:
            least, most = taxels.type.minimum, taxels.type.maximum
            raise ConfigurationError(f'{taxels.type.name} has no range ({least} to {most}): give source = "seen"')
        return Scaler(taxels, self)


class Scaler(Stage):
    """Scales n taxels."""

    name = "scaler"

    def __init__(self, taxels: Taxels, settings: ScalerSettings) -> None:
        before = taxels.type
        scaled = replace(before, unit=NO_UNIT, minimum=settings.low, maximum=settings.high)
        super().__init__(replace(taxels, type=scaled, resolution=0.0))
        self._settings = settings
        is_range = settings.source == "range"
        self._least: Floats = np.full(len(taxels), before.minimum if is_range else np.nan, np.float32)
        self._most: Floats = np.full(len(taxels), before.maximum if is_range else np.nan, np.float32)

    def step(self, signal: Signal) -> None:
        settings = self._settings
        if settings.source == "seen":
            seen = np.where(signal.usable, signal.values, np.float32(np.nan))
            if settings.shrink_s is not None:
                share = np.float32(-math.expm1(-self._passed_s(signal) / settings.shrink_s))
                here = np.where(signal.usable, share, np.float32(0))
                self._least += np.where(signal.usable, seen - self._least, np.float32(0)) * here
                self._most += np.where(signal.usable, seen - self._most, np.float32(0)) * here
            self._least, self._most = np.fmin(self._least, seen), np.fmax(self._most, seen)
        span = self._most - self._least
        share = np.divide(signal.values - self._least, span, out=np.zeros_like(span), where=span > 0)
        signal.values[:] = settings.low + (settings.high - settings.low) * np.clip(share, 0, 1)


class AmplifierSettings(StageSettings, frozen=True, kw_only=True, tag="amplifier"):
    """Settings of an amplifier: gain * value ** exponent + offset, with the sign of the value.

    Attributes:
        gain: factor.
        exponent: below 1, weak touches grow more than strong ones.
        offset: added at the end.
        unit: unit of the result, at most 16 bytes; default: none.
    """

    gain: float = 1.0
    exponent: Positive = 1.0
    offset: float = 0.0
    unit: str = NO_UNIT

    def __post_init__(self) -> None:
        if not math.isfinite(self.gain) or not math.isfinite(self.offset) or self.gain == 0:
            raise ConfigurationError(
                f"gain = {self.gain}, offset = {self.offset}: give finite numbers, and a gain that is not 0"
            )

    def stage(self, taxels: Taxels) -> Stage:
        return Amplifier(taxels, self)


class Amplifier(Stage):
    """Amplifies n taxels."""

    name = "amplifier"

    def __init__(self, taxels: Taxels, settings: AmplifierSettings) -> None:
        self._settings = settings
        ends = self._of(np.array([taxels.type.minimum, taxels.type.maximum]))
        amplified = replace(taxels.type, unit=settings.unit, minimum=float(ends.min()), maximum=float(ends.max()))
        step = taxels.resolution * abs(settings.gain) if settings.exponent == 1 else 0.0
        super().__init__(replace(taxels, type=amplified, resolution=step))

    def step(self, signal: Signal) -> None:
        signal.values[:] = self._of(signal.values)

    def _of(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        settings = self._settings
        bent = values if settings.exponent == 1 else np.sign(values) * np.abs(values) ** settings.exponent
        amplified: npt.NDArray[np.floating] = settings.gain * bent + settings.offset
        return amplified
