"""Define the rule of the baseline in numbers: the settings that a user may change, and the constants behind them.

The rule asks one question: how much of a deviation could be drift? :mod:`.offsets` predicts what each taxel reads at
rest, and how uncertain that is; :mod:`.touches` compares deviations with it; :mod:`.rest` measures the beginning.
docs/tactile/baselines.md has the formulas.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Self

import msgspec

from skinware.errors import ConfigurationError
from skinware.status import Status
from skinware.structure import Structure

UNUSABLE = Status.NEVER_SEEN | Status.STALE | Status.MASKED | Status.NOT_CONNECTED
"""A value with one of these bits is not of its frame."""
SIGNED_TYPES = ("shear_", "force_x", "force_y", "magnetic_field_", "acceleration_", "angular_rate_")
"""Beginnings of the names of types that a touch may move to both sides."""

# Levels of evidence

DRIFT_SIGMA = 3.0
"""Standard deviations: an innovation counts for at most this, and what is left of a load within it may be drift."""
STEPS_OF_A_TOUCH = 2
"""Steps of the raw values that a touch rises by at least: rounding alone moves an untouched value by one."""
OFF_TO_ON = 0.6
"""Share of ``minimum_on``: the least threshold at which a touch ends. A value between both does not flicker."""
EPSILON = 1e-6
"""Share of the level: the least noise, ten times what float32 resolves, of values without steps and noise."""
TINY = 1e-12
"""In the unit of the type: keeps a noise above 0 where the level itself is 0."""
FEW_LEVELS = 2
"""Steps from 0 to the largest value: with no more, each step is a touch, and there is no drift to see."""

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

# Drift, as it is learned

GAIN_SPREAD = 0.3
"""Standard deviation of the gains of taxels to the common mode, around 1, before anything is known."""
GAIN_LASTS_S = 604800.0
"""Seconds, a week, in which a known gain becomes as uncertain as that: gains change as skins age."""
LEAST_GAIN, MOST_GAIN = 0.1, 3.0
"""Outside of them something else moves the taxel."""
FEW_TAXELS = 3.0
"""Free taxels of a patch of which nothing is common; the weight of the common mode grows with their number beyond."""
MATCH_S = 2.0
"""Seconds in which the agility of the common mode changes e-fold, until it explains how the mode moves."""
RATE_S = 30.0
"""Seconds: the speed of the common drift is averaged over this, so that what comes and goes does not count."""
SLOW_S = 5.0
"""Seconds: deviations that last longer are drift of the taxel, quicker ones are its noise."""
NOISE_S = 60.0
"""Seconds: time constant of the noise, which also changes with temperature and with motors nearby."""
TICK_S = 1.0
"""Seconds between adjustments of what changes slowly."""

# Contacts

FALLEN = 0.5
"""Share of the peak of a load: below it the load has fallen, and what is left may be drift."""
PEAK_S = 2.0
"""Seconds: time constant of the peak. A bump of a moment must not make the load after it look fallen."""
USED_S = 40.0
"""Seconds in which the material gets used to a load, and forgets it."""
RESETTLE_S = 3.0
"""Seconds in which a taxel finds back after a load, instead of ``tau_s``."""
FADED = 0.75
"""Share: what is left after a sudden fall, and fades below this by itself, was a remainder."""
MOST_REMAINDER = 0.35
"""Share of a load: no cover keeps more of it."""
STEP_OVER_ON = 3.0
"""Thresholds: a module whose taxels all rise alike by less moved its own baseline."""
ALIKE = 0.3
"""Share of the median: taxels that are nearer to it moved alike."""
MOST_ALIKE = 0.5
"""Share of the taxels of a module that have to."""
SAG_RETURNS_S = 0.6
"""Seconds from the end of a contact in which the cover around it comes back, until that is looked at."""
SAG_RETURNS_BY = 1.5
"""Times the sag: a value that rises farther than this (and a threshold) is a touch, not the cover that comes back."""
SAG_SHARE = 0.3
"""Share of the largest load in the patch: a cover that is pressed sinks around by no more."""


LOOK_AT_S = 0.3
"""Seconds after the beginning of a touch at which it is looked at again: did a module step, or a taxel return?"""
DIP_S = 60.0
"""Seconds in which a taxel that fell, and returns to within a threshold, shows that touches may lower it."""


class Why(IntEnum):
    """Why a taxel is in its state."""

    REST = 0
    """It is at rest."""
    HELD = 1
    """It is touched; its offset is predicted, not measured."""
    RELEARNING = 2
    """Its offset is not known yet, or less well than its noise."""
    COVERED = 3
    """It is below its offset, which was learned under a load or before a cover sank nearby."""
    DOUBTED = 4
    """It falls and returns again and again where nothing touches: its polarity may be wrong."""
    SATURATED = 5
    """It is at the end of its range: it may bear more than it shows."""
    NO_RESOLUTION = 6
    """It has too few levels to show how strong a touch is."""


def resolution_of(structure: Structure, type_name: str) -> float:
    """Return the step of the values of a sensor type, in its unit; 0 for values without steps.

    Raises:
        StructureError: no such type here.
    """
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
