"""Read the loads of a driver, calmed or not, and the poses of a service."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError, Overrun, ServiceTimeout
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import ServiceReader
from skinware.structure import Structure
from skinware.tactile.arrays import Doubles
from skinware.tactile.baseline import UNUSABLE
from skinware.tactile.chain import Chain, ChainSettings
from skinware.tactile.curves import temperature_of

POINT, POSE = "point_m", "pose"
"""Columns of a service of poses: (3,) or (k, 3) points, m; (4, 4) pose of the carrier of a finger, homogeneous, m."""

_COUNT = "count"
_OLDEST_NS = NS_PER_S // 5
_CALM_TYPE = "calm"
_PREFERRED = "pressure"


class LoadSource:
    """The loads of the sensors of one type of a driver: 0 where nothing touches.

    Values of a calmed driver pass unchanged, those of any other driver go through a baseline. Without the name of a
    type it is pressure, or else the driver's first type. ``temperature_c`` is that of the newest frame; NaN: not
    measured.

    Raises:
        StructureError: no such type here.
        ConfigurationError: sensors of that type have no rest.
    """

    def __init__(self, structure: Structure, driver_type: str, type_name: str | None = None) -> None:
        names = [t.name for t in structure.types]
        self.structure = structure
        self.type_name: str = type_name or (_PREFERRED if _PREFERRED in names else names[0])
        self.temperature_c = math.nan
        self._index = structure.index(self.type_name)
        self._chain: Chain | None = None
        if driver_type != _CALM_TYPE:
            self._chain = ChainSettings.calm().chain(structure)
            if self.type_name not in self._chain.baselines:
                raise ConfigurationError(f"{self.type_name} sensors have no rest to return to")
            self._values = np.zeros(structure.n_sensors, np.float32)
            self._status = np.zeros(structure.n_sensors, np.uint8)

    @property
    def ready(self) -> bool:
        """Whether most of the sensors have a baseline."""
        return self._chain is None or bool(self._chain.baselines[self.type_name].ready.mean() > 0.5)

    @property
    def refused_share(self) -> float:
        """Share of the sensors that have no baseline yet because they move."""
        return 0.0 if self._chain is None else self._chain.baselines[self.type_name].refused_share

    def loads(self, frame: DriverSnapshot) -> Doubles:
        """Return (n,) the loads in a frame; NaN where they are not known."""
        if self._chain is None:
            values, status = frame.physical(self.type_name), frame.status_of(self.type_name)
        else:
            self._chain.step(frame, self._values, self._status)
            values, status = self._values[self._index], self._status[self._index]
        self.temperature_c = temperature_of(frame)
        usable = (status & np.uint8(UNUSABLE)) == 0
        loads: Doubles = np.where(usable, values, np.nan).astype(np.float64)
        return loads


class PoseSource:
    """Reads the newest pose of a service, from a column of points (3,) or poses (4, 4).

    A service may have several points and a column ``count`` of those that press: it has a pose while that is one.

    Raises:
        ConfigurationError: the service has no such column of floats.
    """

    def __init__(self, reader: ServiceReader[Any], column: str, shape: tuple[int, ...]) -> None:
        columns = reader.schema.columns
        if column not in columns:
            there_are = ", ".join(columns)
            raise ConfigurationError(f"service {reader.name!r} has no column {column!r}; there are: {there_are}")
        found = tuple(columns[column].shape)
        self._has_count = found[1:] == shape and _COUNT in columns
        if columns[column].dtype.kind != "f" or not (found == shape or found == (1, *shape) or self._has_count):
            raise ConfigurationError(f"column {column!r} of {reader.name!r} is {found}; give {shape}, of floats")
        self._reader, self._column, self._shape = reader, column, shape

    def newest(self) -> Doubles | None:
        """Return the present pose; None if it is older than 0.2 s, or there is none."""
        try:
            frame = self._reader.read(timeout_s=0)
        except (ServiceTimeout, Overrun):
            return None
        if frame.stale or now_ns() - frame.published_ns > _OLDEST_NS:
            return None
        if self._has_count and int(np.asarray(frame.column(_COUNT)).reshape(-1)[0]) != 1:
            return None
        rows = np.asarray(frame.column(self._column), np.float64).reshape(-1, *self._shape)
        pose: Doubles = rows[0].copy()
        return pose


class ForceSource:
    """Pairs the force of a reference with the temperature of the skin.

    The reference reads the force, N: (1,), or (3,), whose length counts. Without one, ``weight_n`` is the known weight
    that presses now, N; NaN: none.
    """

    def __init__(self, source: LoadSource, reference: PoseSource | ForceSource | None) -> None:
        self._source, self._reference = source, reference
        self.weight_n = math.nan

    def newest(self) -> Doubles | None:
        """Return (2,) the present force and temperature, NaN where not known; None without a force."""
        force = np.array([self.weight_n]) if self._reference is None else self._reference.newest()
        if force is None:
            return None
        return np.array([force[0] if len(force) == 1 else np.linalg.norm(force), self._source.temperature_c])
