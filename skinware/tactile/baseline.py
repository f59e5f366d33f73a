"""Follow baselines: what each taxel would read if nothing touched it, while the hardware drifts and contacts last.

One question decides everything: how much of this could be drift? Each taxel has an offset and knows how uncertain it
is. A value that is above the offset by more than noise and uncertainty explain is a touch. Under a touch the offset is
predicted from what the patch has in common, and its uncertainty grows by the drift that was measured at rest. A touch
lasts until its load is gone, or has fallen to what drift could be. All times are those of the samples.
``skinware/native`` computes all this: ``baseline.h`` has its numbers.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import msgspec
import numpy as np
import numpy.typing as npt

from skinware import native
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.native import give_arrays, read_structs
from skinware.status import Status
from skinware.structure import Structure
from skinware.tactile.arrays import Bytes, Flags, Floats, check_state

UNUSABLE = Status.NEVER_SEEN | Status.STALE | Status.MASKED | Status.NOT_CONNECTED
"""A value with one of these bits is not of its frame."""
_FORCES = tuple(f"{of}_{axis}" for of in ("force", "resultant", "total_force") for axis in "xy")
SIGNED_TYPES = ("shear_", *_FORCES, "torque_", "magnetic_field_", "dynamic_pressure")
"""Beginnings of the names of types that a touch may move to both sides."""

FORGET_AFTER_S = 600.0
"""Seconds without data after which a baseline is measured again: a skin that warms up drifts farther than a touch."""


def resolution_of(structure: Structure, type_name: str) -> float:
    """Return the step of the values of a sensor type, in its unit; 0: they have none. Raises StructureError."""
    return 0.0 if structure.dtype.kind == "f" else abs(structure.type(type_name).scale)


_WHERE_NONE = {"minimum_on": math.nan, "maximum_hold_s": math.inf}


class BaselineSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a baseline. Times are in seconds, whatever the rate; levels are in the unit of the type.

    Attributes:
        tau_s: the slowest time constant of a taxel's own drift, away from contacts; it is faster where drift is.
        settle_s: how long after a contact the taxels near it count as held.
        smooth_s: time constant of the deviation that is compared with the thresholds. Published values are not
            smoothed, and the end of a touch shows at once.
        on_sigma: a touch begins above this many standard deviations of noise and offset.
        off_sigma: and ends below this many.
        minimum_on: a touch is at least this high. None: two steps of the raw values; 0 for values without steps.
        recover_s: a taxel that is as far below its baseline as a touch is above it, for this long, gets a new one.
        maximum_hold_s: a touch becomes the baseline after this time; None: never.
        calibrate_s: how long the rest is measured at the start.

    Raises:
        ConfigurationError: a value that makes no sense; the message says which.
    """

    tau_s: float = 30.0
    settle_s: float = 3.0
    smooth_s: float = 0.1
    on_sigma: float = 5.0
    off_sigma: float = 3.0
    minimum_on: float | None = None
    recover_s: float = 1.0
    maximum_hold_s: float | None = None
    calibrate_s: float = 5.0

    def __post_init__(self) -> None:
        for name in ("tau_s", "calibrate_s", "maximum_hold_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ConfigurationError(f"{name} = {value}: give a number of seconds above 0")
        for name in ("settle_s", "smooth_s", "recover_s", "minimum_on", "off_sigma"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise ConfigurationError(f"{name} = {value}: give 0 or more")
        if not self.off_sigma <= self.on_sigma < math.inf:
            raise ConfigurationError(f"on_sigma = {self.on_sigma}: give at least off_sigma, {self.off_sigma}")

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """Return these settings with some changed.

        Raises:
            ConfigurationError: an unknown name, or a value that makes no sense.
        """
        for name, value in changes.items():
            if name not in self.__struct_fields__:
                raise ConfigurationError(f"no setting {name!r}; there are: {', '.join(self.__struct_fields__)}")
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if not is_number and not (value is None and name in _WHERE_NONE):
                raise ConfigurationError(f"{name} = {value!r}: give a number")
        return msgspec.structs.replace(self, **changes)


_STRUCTS = read_structs([Path(native.__file__).with_name("baseline.h")])
_BLOCKS = 60  # numbers of a taxel that is measured
SHOWN = 21
"""Bytes of a taxel that the library shows."""
_NO_VALUE, _NO_NOISE = -1, -2
_LEARNED = (
    *("ready", "level", "gain", "variance", "cross", "noise2", "gain_variance"),
    *("touched", "smooth", "peak", "contact_s", "used"),
)

_calls = native.core().quick
_begin, _lose_common = _calls.skinware_baseline_begin, _calls.skinware_baseline_lose_common
_update, _tare = _calls.skinware_baseline_update, _calls.skinware_baseline_tare
for _call in (_begin, _lose_common, _update, _tare):
    _call.restype = None
_begin.argtypes = _lose_common.argtypes = (ctypes.c_void_p,)
_tare.argtypes, _tare.restype = (ctypes.c_void_p, ctypes.c_int64), ctypes.c_int64
_update.argtypes = (ctypes.c_void_p, ctypes.c_int64, *(ctypes.c_void_p,) * 5)


@dataclass(frozen=True, slots=True, eq=False)
class Calm:
    """One sample of n taxels, calmed. The arrays belong to the caller.

    Attributes:
        value: (n,) float32, how far each touched taxel is above its baseline (of types that a touch may move to both
            sides: from it), in the unit of the type; 0 where nothing touches.
        touched: (n,) bool.
        held: (n,) bool, near a contact, or near where one was some seconds ago.
        baseline: (n,) float32, what each taxel would read if nothing touched it; NaN before that is known.
        uncertainty: (n,) float32, standard deviation of the baseline, and so of ``value``, beside the noise; NaN before
            it is known.
        noise: (n,) float32, standard deviation from sample to sample; NaN before it is known.
        why: (n,) uint8, why each is in its state: a :class:`skinware.status.Why`.
        forced: (n,) bool, the baseline was put where the value is, at once.
        usable: (n,) bool, value and baseline are of this sample; others show what was last known, or nothing yet.
    """

    value: Floats
    touched: Flags
    held: Flags
    baseline: Floats
    uncertainty: Floats
    noise: Floats
    why: Bytes
    forced: Flags
    usable: Flags

    @classmethod
    def of(cls, memory: Bytes) -> Self:
        """Return the arrays in (n * SHOWN,) bytes as the library writes them."""
        n = len(memory) // SHOWN
        values_of = memory[: 16 * n].view(np.float32).reshape(4, n)
        flags_of = memory[16 * n :].view(np.bool_).reshape(5, n)
        return cls(
            value=values_of[0],
            touched=flags_of[0],
            held=flags_of[1],
            baseline=values_of[1],
            uncertainty=values_of[2],
            noise=values_of[3],
            why=memory[18 * n : 19 * n],
            forced=flags_of[3],
            usable=flags_of[4],
        )


class _Given:
    """Memory at one address that (n,) arrays are copied to for C, as finding the address of each takes longer."""

    def __init__(self, n: int, dtype: npt.DTypeLike) -> None:
        self._memory = np.empty(n, dtype)
        self._at = self._memory.ctypes.data

    def take(self, given: npt.ArrayLike | None) -> int | None:
        """Return the address; None: nothing is given."""
        if given is None:
            return None
        self._memory[:] = given
        return self._at


class Baseline:
    """Follows the baselines of the n taxels of one sensor type of one driver.

    Nothing is touched before the rest was measured, for some seconds, however many taxels are covered meanwhile. If
    more than 5 % of them move, those that rest begin, and each of the others begins when it has rested for as long.
    ``tare`` ends the measurement at once. A taxel that sends later, or again after 10 minutes, is measured then.

    Args:
        module: (n,) int, the module of each taxel: its taxels sag and settle together.
        patch: (n,) int, the patch of each taxel: its taxels drift together.
        settings: default: those of the class.
        resolution: the step of the values; 0 if they have none.
        signed: a touch may move a value to both sides.
        common: the taxels of a patch may drift together; False: what they have in common was taken off before.
        limits: least and largest value of the type; a taxel there is saturated.

    Attributes:
        type_name: the sensor type, where it was made for one.
        at: address of its ``struct baseline``, for C.
    """

    def __init__(
        self,
        module: npt.ArrayLike,
        patch: npt.ArrayLike,
        settings: BaselineSettings | None = None,
        *,
        resolution: float = 1.0,
        signed: bool = False,
        common: bool = True,
        limits: tuple[float, float] = (-math.inf, math.inf),
    ) -> None:
        self.type_name: str = ""
        self._suspect: Flags | None = None
        self._n = n = len(np.asarray(patch))
        modules, patches = np.array(module, np.int64), np.array(patch, np.int64)
        starts = np.flatnonzero(np.diff(patches, prepend=-1))
        runs = np.column_stack([starts, np.append(starts[1:], n), patches[starts]])
        n_patches, n_modules = (int(group.max(initial=-1)) + 1 for group in (patches, modules))
        room = {"scratch": 2 * n, "blocks": _BLOCKS * n, "list": n + max(n_patches, n_modules) + 1}
        self._words = words = _STRUCTS["Baseline"]()
        words.n, words.n_patches, words.n_modules, words.n_runs = n, n_patches, n_modules, len(runs)
        words.resolution, words.is_signed, words.forget_after_s = resolution, signed, FORGET_AFTER_S
        words.has_no_common = not common
        words.least, words.most = limits
        given: dict[str, npt.NDArray[Any]] = {
            "runs": np.array(runs, np.int64, order="C"),
            "patch": patches,
            "module": modules,
            "patches": np.zeros((n_patches, ctypes.sizeof(_STRUCTS["Patch"]) // 8)),
            "modules": np.zeros((n_modules, ctypes.sizeof(_STRUCTS["Module"]) // 8)),
        }
        self._arrays = give_arrays(words, n, room, given)
        self.at: int = ctypes.addressof(words)
        self._given = [_Given(n, dtype) for dtype in (np.float32, np.bool_, np.bool_, np.bool_)]
        self.settings = settings or BaselineSettings()
        _begin(self.at)

    @classmethod
    def of(cls, structure: Structure, type_name: str, settings: BaselineSettings | None = None) -> Self:
        """Make one for the sensors of a type, in the order of ``structure.index(type_name)``.

        Raises:
            StructureError: no such type here.
        """
        sensor_type = structure.type(type_name)
        baseline = cls(
            structure.module_of(type_name),
            structure.patch_of(type_name),
            settings,
            resolution=resolution_of(structure, type_name),
            signed=type_name.startswith(SIGNED_TYPES),
            limits=(sensor_type.minimum, sensor_type.maximum),
        )
        baseline.type_name = type_name
        return baseline

    def stand_beside(self, normal: Baseline) -> None:
        """Let the axis along the normal of the same n taxels say where these axes, within the skin, bear no load."""
        self._normal, self._words.normal = normal, normal.at

    @property
    def ready(self) -> Flags:
        """(n,) bool, which taxels have a baseline; a copy."""
        ready: Flags = self._arrays["ready"].copy()
        return ready

    @property
    def refused_share(self) -> float:
        """Share of the taxels that have to wait for a baseline because they move; 0: none has to wait."""
        return float(self._words.refused_share)

    @property
    def doubts(self) -> bool:
        """Whether a touch seems to lower some taxels in the newest sample."""
        return bool(self._words.doubts)

    @property
    def settings(self) -> BaselineSettings:
        """The settings; new ones hold from the next sample on."""
        return self._settings

    @settings.setter
    def settings(self, settings: BaselineSettings) -> None:
        self._settings = settings
        for name in BaselineSettings.__struct_fields__:
            value = getattr(settings, name)
            setattr(self._words, name, _WHERE_NONE[name] if value is None else value)

    def hold(self, on: bool) -> None:
        """Leave all baselines as they are, except for common drift, until ``hold(False)``."""
        self._words.is_held = on

    def tare(self, patch: int | None = None) -> int:
        """Take the present values as the rest, touched or not, of all taxels or of one patch.

        A taxel that has no baseline yet begins with the mean and the noise of its last half second. With fewer than
        four values it begins with the noise of rounding; values without steps go on being measured.

        Returns:
            The number of taxels that were tared.

        Raises:
            ConfigurationError: too few values have come yet.
        """
        number = int(_tare(self.at, -1 if patch is None else patch))
        if number == _NO_VALUE:
            raise ConfigurationError("nothing to tare: no value has come yet")
        if number == _NO_NOISE:
            raise ConfigurationError("nothing to tare: the noise is known after four values; try again in a moment")
        return number

    def take(self, frame: DriverSnapshot) -> Calm:
        """Calm the next sample of the driver; raises StructureError if it has no such sensors."""
        status = frame.status_of(self.type_name)
        before, suspect = self._suspect, (status & Status.SUSPECT) != 0
        self._suspect = suspect
        jumped = None if before is None else suspect & ~before
        return self.update(frame.acquired_ns, frame.physical(self.type_name), (status & UNUSABLE) == 0, jumped=jumped)

    def update(
        self,
        time_ns: int,
        values: npt.ArrayLike,
        usable: npt.ArrayLike | None = None,
        *,
        jumped: npt.ArrayLike | None = None,
        bears: npt.ArrayLike | None = None,
    ) -> Calm:
        """Calm the next sample, given as arrays.

        Args:
            time_ns: of the sample, CLOCK_MONOTONIC or any other clock that goes forwards.
            values: (n,) in the unit of the type, more = more pressure; NaN where nothing is known.
            usable: (n,) bool, which values are of this sample; default: all. The others keep their state, and have no
                influence on anything.
            jumped: (n,) bool, where the hardware moved its own baseline just before this sample; default: nowhere.
            bears: (n,) bool, where the vector of which a value is an axis bears a load; default: nowhere.
        """
        memory = np.empty(SHOWN * self._n, np.uint8)
        at = [given.take(of) for given, of in zip(self._given, (values, usable, jumped, bears), strict=True)]
        _update(self.at, time_ns, *at, memory.ctypes.data)
        return Calm.of(memory)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that was learned, by name: arrays (n,), copies."""
        return {name: self._arrays[name].copy() for name in _LEARNED}

    def restore(self, state: Mapping[str, npt.NDArray[Any]], rows: npt.NDArray[np.integer]) -> int:
        """Go on with what another baseline of m taxels had learned, contacts included; return how many are ready now.

        (n,) ``rows`` say where each taxel stands there; -1: nowhere.

        Raises:
            ConfigurationError: that is no such state.
        """
        here, learned = rows >= 0, {name: self._arrays[name] for name in _LEARNED}
        check_state("a baseline", state, learned, rows)
        here[here] = state["ready"][rows[here]]
        for name in learned:
            here[here] = np.isfinite(state[name][rows[here]])
        for name, array in learned.items():
            array[here] = state[name][rows[here]]
        _lose_common(self.at)
        return int(here.sum())
