"""Define the rule of the baseline in numbers: the settings that a user may change, and the constants behind them.

A level above a taxel's own baseline and noise is a touch, with hysteresis. :mod:`.touches` judges touches and their
ends, :mod:`.drift` follows baselines, :mod:`.rest` measures them first; docs/tactile/baselines.md has the formulas.
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

# Thresholds of touch

STEPS_OF_A_TOUCH = 3
"""Steps of the raw values that a touch rises by. Rounding alone moves an untouched value by one, drift by another."""
OFF_TO_ON = 0.6
"""Share of ``minimum_on``: the least threshold at which a touch ends. A value between both does not flicker."""
QUIET_TO_TYPICAL = 0.25
"""Share of the median noise: no taxel counts as quieter. Seconds of rounded values may show no noise at all."""
EPSILON = 1e-6
"""Share of the baseline: the least noise, ten times what float32 resolves, of values without steps and noise."""
TINY = 1e-12
"""In the unit of the type: keeps a threshold above 0 where the baseline itself is 0."""

# The first measurement

BLOCKS = 10
"""Parts of ``calibrate_s``: the median over ten survives a touch of a third of the time."""
BLOCK_FRAMES = 4
"""Frames: a part is longer at a low rate, as a variance of fewer says nothing."""
ENOUGH_BLOCKS = 0.6
"""Share of the parts in which a taxel must have data."""
MOVED_SHARE = 0.05
"""Share of the taxels that may move meanwhile. Where more do, people use the skin: taxels that move have to wait."""
FORGET_AFTER_S = 600.0
"""Seconds without data after which a baseline is measured again: a skin that warms up drifts farther than a touch."""

# Contacts and their ends

LEVEL_RISES_S = 2.0
"""Seconds: time constant of a contact's load while it grows. A bump of a moment must not raise the level."""
LEVEL_FALLS_S = 20.0
"""Seconds: the same while it shrinks. A weaker grip becomes the level, and the next release is judged by it."""
ENDING_SHARE = 0.5
"""Share of the smoothed load: a value that falls below it ends its touch at once, without the delay of smoothing."""
DRIFT_PER_MIN = 0.25
"""Thresholds a minute: the default of ``drift_max_per_min``. With more of it, an eased grip vanishes."""
JUST_TOUCHED = 1.25
"""Thresholds: the most that a taxel shows which drifted past its threshold a moment ago."""
SAG_RETURNS_S = 0.3
"""Seconds after a touch in which the module still gives back how far it sagged: that belongs to the contact."""

# Drift

LEAST_FACTOR, MOST_FACTOR = 0.2, 3.0
"""Ratios: the drift of a taxel by that of its patch. Outside of them something else moves the taxel."""
FREE_SHARE = 0.5
"""Share of a patch that must be away from contacts, or its common drift counts as unknown."""
DOUBT = 0.3
"""Thresholds: a common drift this long weighs as much as the first guess that a taxel's factor is 1."""
STRETCH = 2.0
"""Thresholds of common drift after which a factor is learned again, with half the weight on what was known."""
LEVEL_EVERY_S = 1.0
"""Seconds between corrections of the typical factor of a patch to 1, without which factors and drift float apart."""
COVER_RETURNS_S = 0.5
"""Seconds after the last touch of a module in which free taxels of its patch give back how far they sagged."""
COVER_RETURNS_BY = 1.5
"""Times the sag: a value that rises farther than this (and a threshold) is a touch, not the cover that comes back."""


def resolution_of(structure: Structure, type_name: str) -> float:
    """Return the step of the values of a sensor type, in its unit; 0 for values without steps.

    Raises:
        StructureError: no such type here.
    """
    return 0.0 if structure.dtype.kind == "f" else abs(structure.type(type_name).scale)


_MAY_BE_NONE = ("minimum_on", "drift_max_per_min", "maximum_hold_s")


class BaselineSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a baseline. Times are in seconds, whatever the rate; levels are in the unit of the type.

    Attributes:
        tau_s: time constant of a taxel's own drift, away from contacts.
        common_tau_s: time constant of the drift that a patch has in common.
        settle_s: how long after a contact the taxels near it keep their own baselines.
        smooth_s: time constant of the level that is compared with the thresholds. Published values are not smoothed,
            and the end of a touch shows at once.
        on_sigma: a touch begins above this many standard deviations of the noise.
        off_sigma: and ends below this many.
        minimum_on: a touch is at least this high. None: three steps of the raw values; 0 for values without steps.
        drift_max_per_min: the most that a baseline drifts under a contact in a minute. None: a quarter of a threshold.
        release: a contact is over when less than this share of its load is left
        release_s: for this long.
        recover_s: a taxel that is as far below its baseline as a touch is above it, for this long, gets a new one.
        maximum_hold_s: a touch becomes the baseline after this time; None: never.
        calibrate_s: how long the rest is measured at the start.

    Raises:
        ConfigurationError: a value that makes no sense; the message says which.
    """

    tau_s: float = 30.0
    common_tau_s: float = 5.0
    settle_s: float = 3.0
    smooth_s: float = 0.1
    on_sigma: float = 5.0
    off_sigma: float = 3.0
    minimum_on: float | None = None
    drift_max_per_min: float | None = None
    release: float = 0.35
    release_s: float = 1.0
    recover_s: float = 1.0
    maximum_hold_s: float | None = None
    calibrate_s: float = 5.0

    def __post_init__(self) -> None:
        for name in ("tau_s", "common_tau_s", "calibrate_s", "maximum_hold_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ConfigurationError(f"{name} = {value}: give a number of seconds above 0")
        for name in ("settle_s", "smooth_s", "release_s", "recover_s", "minimum_on", "drift_max_per_min", "off_sigma"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < math.inf:
                raise ConfigurationError(f"{name} = {value}: give 0 or more")
        if not self.off_sigma <= self.on_sigma < math.inf:
            raise ConfigurationError(f"on_sigma = {self.on_sigma}: give at least off_sigma, {self.off_sigma}")
        if not 0 <= self.release < 1:
            raise ConfigurationError(f"release = {self.release}: give a share, 0 to below 1")

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
