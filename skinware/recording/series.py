"""Recorded frames as whole columns: arrays of (time, sensor)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from skinware.errors import StructureError
from skinware.realtime import NS_PER_S
from skinware.status import is_fresh
from skinware.structure import Structure
from skinware.transfer.generation import Generation


class Series:
    """n frames of one service, whose columns and tables are the same in all of them.

    Args:
        origin: one of their generations.
        headers: (n,) of :data:`skinware.transfer.codec.HEADER`.
        time_s: (n,) when each was published, s since the recording began.
        columns: (n, ...) by name.

    Attributes:
        origin, headers, time_s, columns: as given.
        generation: (n,) uint64, which incarnation of the service each frame belongs to.
        sequence: (n,) uint64, number of each within it; a gap are frames that were lost.
        acquired_ns: (n,) int64, newest time stamp of the data in each, CLOCK_MONOTONIC of the machine that recorded.
        published_ns: (n,) int64, when the writer handed it out, likewise.
        flags: (n,) uint64, bits for the service's own use.
    """

    def __init__(
        self,
        origin: Generation,
        headers: npt.NDArray[np.void],
        time_s: npt.NDArray[np.float64],
        columns: Mapping[str, npt.NDArray[Any]],
    ) -> None:
        self.origin, self.headers, self.columns = origin, headers, columns
        self.time_s = time_s
        self.generation: npt.NDArray[np.uint64] = headers["generation"]
        self.sequence: npt.NDArray[np.uint64] = headers["sequence"]
        self.acquired_ns: npt.NDArray[np.int64] = headers["acquired_ns"]
        self.published_ns: npt.NDArray[np.int64] = headers["published_ns"]
        self.flags: npt.NDArray[np.uint64] = headers["flags"]

    @classmethod
    def joined(cls, parts: Sequence[Series]) -> Series:
        """Frames of one service, one after the other.

        Args:
            parts: at least one, all with the same columns.
        """
        return cls(
            parts[0].origin,
            np.concatenate([part.headers for part in parts]),
            np.concatenate([part.time_s for part in parts]),
            {name: np.concatenate([part.column(name) for part in parts]) for name in parts[0].columns},
        )

    def __len__(self) -> int:
        return len(self.sequence)

    @property
    def structure(self) -> Structure:
        """The structure of the driver.

        Raises:
            StructureError: it is not a driver.
        """
        if not self.origin.is_driver:
            raise StructureError(f"service {self.origin.name!r} is not a driver: it has no sensors")
        return cast(Structure, self.origin.context)

    def column(self, name: str) -> npt.NDArray[Any]:
        """(n, ...) one column of all frames.

        Raises:
            KeyError: no such column, or it was not read.
        """
        try:
            return self.columns[name]
        except KeyError:
            there_are = f"there are {', '.join(self.columns)}"
            known = "was not read" if name in self.origin.columns else "is not there"
            raise KeyError(f"column {name!r} {known}; {there_are}") from None

    # -- by type ------------------------------------------------------------------------------------------------

    def raw(self, type_name: str) -> npt.NDArray[Any]:
        """(n, sensors) raw counts of all sensors of a type, in the order of ``structure.index``.

        Raises:
            StructureError: no such type here; the same for all that take a type.
        """
        return self.column("values")[:, self.structure.index(type_name)]

    def physical(self, type_name: str) -> npt.NDArray[np.floating[Any]]:
        """(n, sensors) float32 values in the type's unit; float64 where raw values are int32."""
        return self.structure.physical(self.column("values"), type_name)

    def status_of(self, type_name: str) -> npt.NDArray[np.uint8]:
        """(n, sensors) uint8, bits of :class:`skinware.Status`."""
        return self.column("status")[:, self.structure.index(type_name)]

    def time_ns(self, type_name: str) -> npt.NDArray[np.int64]:
        """(n, sensors) int64: time of the data of each sensor (of its update group), 0: never seen."""
        structure = self.structure
        times_ns = self.column("group_time_ns" if "group_time_ns" in self.origin.columns else "module_time_ns")
        return times_ns[:, structure.sensor_group[structure.index(type_name)]]

    def fresh(self, type_name: str, *, max_age_s: float | None = None) -> npt.NDArray[np.bool_]:
        """(n, sensors) bool: which could be trusted when their frame was published.

        Args:
            type_name: which sensors.
            max_age_s: the age beyond which nothing is fresh; default: as for :meth:`skinware.DriverSnapshot.fresh`.
        """
        limits_ns = self.structure.age_limits_ns(self.origin.period_ns)[self.structure.index(type_name)]
        max_age_ns = limits_ns if max_age_s is None else round(max_age_s * NS_PER_S)
        at_ns = self.published_ns[:, np.newaxis]
        return is_fresh(self.status_of(type_name), self.time_ns(type_name), at_ns=at_ns, max_age_ns=max_age_ns)

    def __repr__(self) -> str:
        return f"<Series of {len(self)} frames of {self.origin.name!r}: {', '.join(self.columns)}>"
