"""A driver's end and a user's end of one skin: a service whose frames are sensor values, with their structure.

Columns of a frame: ``values``, ``status``, ``module_time_ns``, ``patch_state``, ``bus_state``, ``bus_reason``,
``bus_since_ns``, ``bus_load``, ``bus_counters``, ``patch_counters``, ``patch_interval_counts``, ``patch_age_counts``.
Static columns: the structure's tables, ``driver_type`` and the names of the counters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt

from skinware.driver_frame import DriverFrame
from skinware.errors import BadServiceFile, StructureError
from skinware.memory import _segment
from skinware.memory.namespace import Namespace
from skinware.memory.statistics import BUCKETS
from skinware.service import DEFAULT_SLOTS, Columns, RequestServer, ServiceReader, ServiceWriter
from skinware.structure import Structure

__all__ = ["KIND", "DriverFrame", "DriverReader", "DriverWriter"]

KIND = "driver"


class DriverWriter:
    """A driver's end: a structure, and the frames that go with it.

    Args:
        name: name of the driver in the namespace.
        structure: what the skin is made of.
        driver_type: name of the driver's class (``roboskin``), for people.
        bus_counters: names of the counters that every bus has.
        patch_counters: names of the counters that every patch has.
        namespace, slots, rate_hz, group, operations: as for :class:`skinware.service.ServiceWriter`, which also lists
            the errors.
    """

    def __init__(
        self,
        name: str,
        structure: Structure,
        *,
        driver_type: str = "",
        bus_counters: Sequence[str] = (),
        patch_counters: Sequence[str] = (),
        namespace: Namespace | str | None = None,
        slots: int = DEFAULT_SLOTS,
        rate_hz: float | None = None,
        group: str | None = None,
        operations: Mapping[str, Callable[..., object]] | None = None,
    ) -> None:
        self.structure: Structure = structure
        self._names = (driver_type, tuple(bus_counters), tuple(patch_counters))
        self._service = ServiceWriter(
            name,
            self._columns(),
            self._static(),
            namespace=namespace,
            kind=KIND,
            slots=slots,
            rate_hz=rate_hz,
            group=group,
            operations=operations,
        )

    @property
    def name(self) -> str:
        """Name of the driver."""
        return self._service.name

    @property
    def namespace(self) -> Namespace:
        """Where it publishes."""
        return self._service.namespace

    @property
    def sequence(self) -> int:
        """Sequence of the newest frame, 0 before the first."""
        return self._service.sequence

    @property
    def position(self) -> tuple[int, int]:
        """(generation, sequence) of the newest frame."""
        return self._service.position

    @property
    def paused(self) -> bool:
        """Whether ``pause`` was called last."""
        return self._service.paused

    def pause(self) -> None:
        """Publish nothing until ``resume``; users are told."""
        self._service.pause()

    def resume(self) -> None:
        """Go on after ``pause``."""
        self._service.resume()

    def request_server(self) -> RequestServer:
        """Where users' requests come in; see :class:`skinware.service.ServiceWriter`."""
        return self._service.request_server()

    @property
    def closed(self) -> bool:
        """Whether ``close`` was called, or this is the child of a fork."""
        return self._service.closed

    def begin(self, *, from_last: bool = False) -> dict[str, npt.NDArray[Any]]:
        """Arrays of the next frame by column name, to be filled; then ``commit``.

        Args:
            from_last: begin with the newest frame, to change parts of it only.
        """
        return self._service.begin(from_last=from_last)

    def commit(self, acquired_ns: int) -> int:
        """Publish; ``acquired_ns`` is the newest time stamp in the frame. Returns its sequence."""
        return self._service.commit(acquired_ns)

    def restructure(self, structure: Structure, *, rate_hz: float | None = None) -> None:
        """Go on with other sensors or another dtype, as a new generation; users are told.

        Args:
            structure: the new one. With an equal one users go over without noticing.
            rate_hz: the nominal rate from now on, if it is another.

        Raises:
            NamespaceError: shared memory is full; the old generation then goes on.
        """
        before, self.structure = self.structure, structure
        try:
            self._service.restructure(self._columns(), self._static(), rate_hz=rate_hz)
        except BaseException:
            self.structure = before
            raise

    def close(self) -> None:
        """Withdraw the driver. Idempotent."""
        self._service.close()

    def _columns(self) -> Columns:
        structure = self.structure
        _, bus_counters, patch_counters = self._names
        return {
            "values": (structure.dtype, structure.n_sensors),
            "status": ("u1", structure.n_sensors),
            "module_time_ns": ("<i8", structure.n_modules),
            "patch_state": ("u1", structure.n_patches),
            "bus_state": ("u1", len(structure.buses)),
            "bus_reason": ("u1", len(structure.buses)),
            "bus_since_ns": ("<i8", len(structure.buses)),
            "bus_load": ("<u2", len(structure.buses)),
            "bus_counters": ("<u8", len(structure.buses) * len(bus_counters)),
            "patch_counters": ("<u8", structure.n_patches * len(patch_counters)),
            "patch_interval_counts": ("<u8", structure.n_patches * BUCKETS),
            "patch_age_counts": ("<u8", structure.n_patches * BUCKETS),
        }

    def _static(self) -> dict[str, npt.NDArray[Any]]:
        driver_type, bus_counters, patch_counters = self._names
        return {
            **self.structure.to_columns(),
            "driver_type": np.array([driver_type.encode()], "S32"),
            "bus_counter_name": np.array([name.encode() for name in bus_counters], "S24"),
            "patch_counter_name": np.array([name.encode() for name in patch_counters], "S24"),
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class DriverReader(ServiceReader[DriverFrame]):
    """A user's end of one driver. Everything of :class:`skinware.service.ServiceReader`, and the structure.

    Raises:
        BadServiceFile: the service is not a driver, or its tables contradict each other.
    """

    frame_class = DriverFrame

    @property
    def structure(self) -> Structure:
        """The structure of the generation that is being read."""
        return cast(Structure, self._ring.context)

    @property
    def driver_type(self) -> str:
        """Name of the driver's class, as it told."""
        return bytes(self.static()["driver_type"][0]).decode()

    def bus_counters(self, frame: DriverFrame) -> list[dict[str, int]]:
        """The counters of every bus in a frame, by name."""
        return self._counters(frame, "bus", len(self.structure.buses))

    def patch_counters(self, frame: DriverFrame) -> list[dict[str, int]]:
        """The counters of every patch in a frame, by name."""
        return self._counters(frame, "patch", self.structure.n_patches)

    def _counters(self, frame: DriverFrame, what: str, count: int) -> list[dict[str, int]]:
        names = [bytes(name).decode() for name in self.static()[f"{what}_counter_name"]]
        rows = frame.column(f"{what}_counters").reshape(count, len(names)).tolist()
        return [dict(zip(names, row, strict=True)) for row in rows]

    def _describe(self, attached: _segment.Segment) -> Structure:
        if bytes(attached.header["kind"]) != KIND.encode():
            raise BadServiceFile(f"service {self.name!r} is not a driver: it has no sensors")
        columns = {column.name: column for column in attached.layout.slot}
        try:
            structure = Structure.from_columns(attached.static_columns(), columns["values"].dtype)
            expected = {
                "values": structure.n_sensors,
                "status": structure.n_sensors,
                "module_time_ns": structure.n_modules,
                "patch_state": structure.n_patches,
                "bus_state": len(structure.buses),
            }
            optional = dict.fromkeys(("bus_reason", "bus_since_ns", "bus_load"), len(structure.buses))
            optional |= dict.fromkeys(("patch_interval_counts", "patch_age_counts"), structure.n_patches * BUCKETS)
            expected |= {name: count for name, count in optional.items() if name in columns}
            for name, count in expected.items():
                if columns[name].count != count:
                    raise StructureError(f"{columns[name].count} {name} for {count} rows of the structure")
        except (ValueError, TypeError, LookupError, OverflowError) as error:  # StructureError is a ValueError
            raise BadServiceFile(f"{attached.path}: {error}; not attached") from None
        return structure
