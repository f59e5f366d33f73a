"""What a world gives: frames as a driver would publish them, with the truth beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.status import Status

_UNUSABLE = Status.NEVER_SEEN | Status.STALE | Status.MASKED | Status.NOT_CONNECTED


@dataclass(frozen=True)
class Block:
    """m frames of n taxels.

    Attributes:
        time_ns: (m,) int64, when each frame's newest data was acquired.
        module_time_ns: (m, n_modules) int64, when each module's data was acquired.
        values: (m, n), pressure-positive, of the world's dtype.
        status: (m, n) uint8, bits of :class:`skinware.Status`.
        truth: (m, n) float32, the load in counts: what the values would show of it without drift, noise, sag, creep
            or faults. It does not clip.
    """

    time_ns: npt.NDArray[np.int64]
    module_time_ns: npt.NDArray[np.int64]
    values: npt.NDArray[np.generic]
    status: npt.NDArray[np.uint8]
    truth: npt.NDArray[np.float32]

    @classmethod
    def joined(cls, blocks: Sequence[Block]) -> Block:
        """One after the other.

        Raises:
            ConfigurationError: there is none.
        """
        if not blocks:
            raise ConfigurationError("no frames: the time is over before it began")
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(block, name) for block in blocks]) for name in names))

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def usable(self) -> npt.NDArray[np.bool_]:
        """(m, n) bool: there is data, and it is not old or switched off."""
        usable: npt.NDArray[np.bool_] = (self.status & np.uint8(_UNUSABLE)) == 0
        return usable

    def __iter__(self) -> Iterator[Sample]:
        usable = self.usable
        for row in range(len(self)):
            yield Sample(
                int(self.time_ns[row]),
                self.module_time_ns[row],
                self.values[row],
                self.status[row],
                usable[row],
                self.truth[row],
            )


@dataclass(frozen=True, slots=True)
class Sample:
    """One frame; see :class:`Block`, of which it is a row: its arrays are (n,) and (n_modules,)."""

    time_ns: int
    module_time_ns: npt.NDArray[np.int64]
    values: npt.NDArray[np.generic]
    status: npt.NDArray[np.uint8]
    usable: npt.NDArray[np.bool_]
    truth: npt.NDArray[np.float32]
