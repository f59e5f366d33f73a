"""From values to what is sent of a taxel: one byte for its value, one for its status, two for its shear."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.status import Status

Levels = npt.NDArray[np.uint8]

HIGHEST = 250
NO_VALUE = 255
WITHOUT_VALUE = Status.NO_ACK | Status.MASKED | Status.NEVER_SEEN | Status.NOT_CONNECTED
"""Of these a value means nothing."""
_LONGEST = 127
_STEEPEST = float(np.finfo(np.float32).max)


def levels_of(values: npt.NDArray[np.floating[Any]], status: npt.NDArray[np.uint8], low: float, high: float) -> Levels:
    """(n,) uint8: where values lie between ``low`` (0) and ``high`` (250), in even steps; 255 where there is no value.

    Args:
        values: (n,) physical.
        status: (n,) uint8, bits of :class:`skinware.status.Status`.
        low: what is level 0, and all below it.
        high: what is level 250, and all above it.
    """
    scaled = (values - values.dtype.type(low)).astype(np.float32, copy=False)
    known = np.isfinite(scaled)
    if not known.all():
        scaled[~known] = 0
    steepness = HIGHEST / (high - low) if high > low else np.inf
    scaled *= np.float32(min(steepness, _STEEPEST))
    scaled += np.float32(0.5)
    np.clip(scaled, 0, HIGHEST, out=scaled)
    levels = scaled.astype(np.uint8)
    if not known.all():
        levels[~known] = NO_VALUE
    levels[(status & np.uint8(WITHOUT_VALUE)) != 0] = NO_VALUE
    return levels


def shear_of(vectors: npt.NDArray[np.floating[Any]], longest: float) -> npt.NDArray[np.int8]:
    """(n, 2) int8: vectors as parts of ``longest``, which is 127; 0 where one is not known."""
    scaled = np.nan_to_num(vectors * np.float32(_LONGEST / longest if longest > 0 else 0.0), posinf=0.0, neginf=0.0)
    parts: npt.NDArray[np.int8] = np.clip(np.rint(scaled), -_LONGEST, _LONGEST).astype(np.int8)
    return parts
