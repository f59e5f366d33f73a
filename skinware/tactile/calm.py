"""What a baseline tells of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

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
