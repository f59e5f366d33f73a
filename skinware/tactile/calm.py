"""Hold the settings of a baseline and what it returns for a sample."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError

Floats = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Calm:
    """n taxels, calmed. The arrays belong to the caller.

    Attributes:
        value: (n,) float32, how far each touched taxel is above its baseline (of types that a touch may move to both
            sides: from it), in the unit of the type; 0 where nothing touches.
        touched: (n,) bool.
        held: (n,) bool, near a contact, or near where one was some seconds ago.
        baseline: (n,) float32, what each taxel would read if nothing touched it; NaN before that is known.
        noise: (n,) float32, standard deviation from frame to frame; NaN before it is known.
        forced: (n,) bool, the baseline was put where the value is, at once.
        usable: (n,) bool, value and baseline are of this frame; others show what was last known, or nothing yet.
    """

    value: Floats
    touched: Flags
    held: Flags
    baseline: Floats
    noise: Floats
    forced: Flags
    usable: Flags


_MAY_BE_NONE = ("minimum_on", "drift_max_per_min", "maximum_hold_s")


class BaselineSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of a baseline. Times are in seconds, whatever the rate; levels in the unit of the type.

    Attributes:
        tau_s: time constant of a taxel's own drift, away from contacts.
        common_tau_s: time constant of the drift that is common to a patch.
        settle_s: how long after a contact the taxels near it keep their own baselines.
        smooth_s: time constant of what is compared with the thresholds, but for the end of a touch, which shows at
            once; values themselves are not smoothed.
        on_sigma: a touch begins above so many standard deviations of the noise.
        off_sigma: and ends below so many.
        minimum_on: and begins above this at least. None: three steps of the raw values; 0 for those that have no steps.
        drift_max_per_min: what a baseline can lose at most under a contact, in a minute. None: a quarter of a
            threshold of touch.
        release: a contact is over when less than this share of its load is left
        release_s: for so long.
        recover_s: a taxel that is as far below its baseline as a touch is above it, for so long, gets a new one.
        maximum_hold_s: after so long a touch is taken for the baseline; None: never.
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
        """These settings, but for some.

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
