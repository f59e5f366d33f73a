"""What is wrong with a skin: broken taxels, exchanged connectors, patches that fall silent, baselines that jump."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from skinware.status import Status

ArrayF = npt.NDArray[np.float64]
ArrayI = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Missing:
    """Taxels without data for a while.

    Attributes:
        taxels: (k,) their numbers.
        begin_s: from then on.
        end_s: until then.
        status: what the driver says of them meanwhile.
        value: what stands in their place; None: what was there before (before the first frame: 0).
    """

    taxels: ArrayI
    begin_s: float
    end_s: float
    status: Status
    value: float | None


@dataclass(frozen=True)
class Jump:
    """A board that moved its baseline.

    Attributes:
        taxels: (k,) their numbers.
        counts: by which the values move.
        at_s: when.
        suspect_s: for how long the driver calls them suspect; 0 if it does not notice.
    """

    taxels: ArrayI
    counts: float
    at_s: float
    suspect_s: float


@dataclass
class Faults:
    """All faults of a world of n taxels.

    Attributes:
        feels: (n,) bool, False: the taxel feels no load.
        noise: (n,) factor on its noise.
        stuck: (n,) the value that a taxel always shows; NaN: it is not stuck.
        source: (n,) the taxel whose data arrives in each one's place.
        missing: see :class:`Missing`.
        jumps: see :class:`Jump`.
    """

    feels: npt.NDArray[np.bool_]
    noise: ArrayF
    stuck: ArrayF
    source: ArrayI
    missing: list[Missing] = field(default_factory=list)
    jumps: list[Jump] = field(default_factory=list)

    @classmethod
    def none(cls, n: int) -> Faults:
        return cls(np.ones(n, bool), np.ones(n), np.full(n, np.nan), np.arange(n))

    def jumped(self, time_s: ArrayF, patch: ArrayI) -> tuple[ArrayF | None, npt.NDArray[np.bool_] | None]:
        """What jumps add to the values of (m, n_patches) times, and who is suspect then: (m, n), or None if nothing.

        Args:
            time_s: (m, n_patches) of the acquisitions.
            patch: (n,) of the taxels.
        """
        if not any(time_s[-1].max() >= jump.at_s for jump in self.jumps):
            return None, None
        added, suspect = np.zeros((len(time_s), len(patch))), np.zeros((len(time_s), len(patch)), bool)
        for jump in self.jumps:
            at_s = time_s[:, patch[jump.taxels]]
            added[:, jump.taxels] += jump.counts * (at_s >= jump.at_s)
            suspect[:, jump.taxels] |= (at_s >= jump.at_s) & (at_s < jump.at_s + jump.suspect_s)
        return added, suspect
