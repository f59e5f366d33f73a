"""What strokes tell of a skin without any pose: which taxels feel the same at the same time, and so lie near."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError

ArrayF = npt.NDArray[np.float64]

MOST_TAXELS = 6000
"""Every taxel is compared with every other one: so many need 290 MB."""
ENOUGH_FRAMES = 20
"""A taxel that felt something in so many frames is covered."""
_LEAST_FRAMES = 8
"""With fewer, what a taxel felt may be noise, and tells nothing."""


@dataclass
class StrokeSums:
    """The sums over all frames that a topology is found from.

    Attributes:
        products: (n, n) float64, sum of the products of the loads of each pair of taxels.
        active: (n,) int64, frames in which each felt something.
        frames: number of frames in which any of them did.
    """

    products: ArrayF
    active: npt.NDArray[np.int64]
    frames: int = 0

    @classmethod
    def empty(cls, n: int) -> Self:
        """Of n taxels, before the first frame.

        Raises:
            ConfigurationError: there are too many.
        """
        if n > MOST_TAXELS:
            raise ConfigurationError(f"{n} taxels: a topology is found of at most {MOST_TAXELS} at a time")
        return cls(np.zeros((n, n)), np.zeros(n, np.int64))

    def __len__(self) -> int:
        return len(self.active)

    def add(self, load: npt.NDArray[Any]) -> None:
        """Take one frame, or many.

        Args:
            load: (n,) or (m, n): 0 where nothing touches, NaN where it is not known.
        """
        loads = np.nan_to_num(np.atleast_2d(np.asarray(load, np.float64)), posinf=0.0)
        np.maximum(loads, 0, out=loads)
        loads = loads[(loads > 0).any(axis=1)]
        if not len(loads):
            return
        taxels = np.flatnonzero((loads > 0).any(axis=0))
        felt = loads[:, taxels]
        self.products[np.ix_(taxels, taxels)] += felt.T @ felt
        self.active[taxels] += (felt > 0).sum(axis=0)
        self.frames += len(loads)

    @property
    def covered(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: felt something in at least 20 frames."""
        return self.active >= ENOUGH_FRAMES

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: felt something in enough frames to be compared with others."""
        return self.active >= _LEAST_FRAMES

    def similarity(self) -> ArrayF:
        """(n, n), 0 to 1: the cosine between what two taxels felt over time; 0 with one that is not known."""
        length = np.sqrt(np.diag(self.products))
        known = self.known & (length > 0)
        scale = np.where(known, 1 / np.where(known, length, 1), 0)
        similarity: ArrayF = np.clip(self.products * scale[:, None] * scale, 0, 1)
        return similarity
