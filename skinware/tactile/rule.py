"""Define the settings of the rule of baselines.

``skinware/native/baseline.h`` has the numbers behind them, docs/tactile/baselines.md the formulas.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Self

import msgspec

from skinware.errors import ConfigurationError
from skinware.status import Status
from skinware.structure import Structure

UNUSABLE = Status.NEVER_SEEN | Status.STALE | Status.MASKED | Status.NOT_CONNECTED
"""A value with one of these bits is not of its frame."""
SIGNED_TYPES = ("shear_", "force_x", "force_y", "magnetic_field_", "acceleration_", "angular_rate_")
"""Beginnings of the names of types that a touch may move to both sides."""

FORGET_AFTER_S = 600.0
"""Seconds without data after which a baseline is measured again: a skin that warms up drifts farther than a touch."""


def resolution_of(structure: Structure, type_name: str) -> float:
    """Return the step of the values of a sensor type, in its unit; 0: they have none. Raises StructureError."""
    return 0.0 if structure.dtype.kind == "f" else abs(structure.type(type_name).scale)


_MAY_BE_NONE = ("minimum_on", "maximum_hold_s")


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
            if not is_number and not (value is None and name in _MAY_BE_NONE):
                raise ConfigurationError(f"{name} = {value!r}: give a number")
        return msgspec.structs.replace(self, **changes)
