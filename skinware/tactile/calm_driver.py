"""Read the driver that is calmed, and publish it again."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader, DriverWriter
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import BadServiceFile, Overrun, Paused, ServiceNotFound, ServiceTimeout, StructureChanged
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S, WAIT_SLICE_NS, now_ns
from skinware.status import PatchState, Status
from skinware.structure import Structure

_WAIT_S = WAIT_SLICE_NS / NS_PER_S


class DriverSource:
    """Reads each sample of a driver that may stop, restart and change; ``reader`` is None before it was found."""

    def __init__(self, name: str, namespace: Namespace) -> None:
        self._name, self._namespace = name, namespace
        self.reader: DriverReader | None = None
        self._is_first = True
        self._structure: Structure | None = None

    @property
    def alive(self) -> bool:
        return self.reader is not None and self.reader.alive

    def next_frame(self) -> DriverSnapshot | None:
        """Return the next sample, if it comes within 50 ms; none of a driver that was dead when it was found."""
        try:
            if self.reader is None:
                self.reader = DriverReader(self._name, namespace=self._namespace)
                return None
            try:
                frame = self.reader.read_next(timeout_s=_WAIT_S)
            except StructureChanged:
                self.reader.reattach()
                return None
        except (ServiceTimeout, Overrun):
            return None
        except (ServiceNotFound, BadServiceFile):
            time.sleep(_WAIT_S)
            return None
        is_first, self._is_first = self._is_first, False
        return None if frame.stale and is_first else frame

    def has_changed(self, frame: DriverSnapshot) -> bool:
        """Whether a sample has another structure than the sample before it."""
        before, self._structure = self._structure, frame.structure
        return frame.structure is not before and frame.structure != before

    def close(self) -> None:
        if self.reader is not None:
            self.reader.close()


SENSOR_COLUMNS = {"uncertainty": "<f4", "why": "u1"}
"""Dtypes, by name, of the columns of a calmed driver with an entry per sensor, beside values and status."""


class CalmedDriver:
    """Publishes a driver again, with the output of a chain, and how far that can be trusted.

    ``uncertainty`` is in the unit in which values come to the baseline, NaN without one;
    ``why`` is a :class:`skinware.status.Why`. The writer is None before the driver was seen.
    """

    def __init__(
        self, name: str, into: Namespace, group: str | None, operations: Mapping[str, Callable[..., object]]
    ) -> None:
        self._name, self._into, self._group, self._operations = name, into, group, operations
        self.writer: DriverWriter | None = None
        self._counters: list[list[str]] = []
        self._copied: list[str] = []
        self._unknown: list[str] = []

    def follow(self, structure: Structure, source: DriverReader, rate_hz: float | None) -> None:
        """Go on with another structure; the reader of the driver knows its counters and columns."""
        static = source.static()
        names = [f"{what}_counter_name" for what in ("bus", "patch")]
        counters = [[bytes(one).decode() for one in static[name].tolist()] if name in static else [] for name in names]
        if self.writer is not None and counters == self._counters:
            self.writer.restructure(structure, rate_hz=rate_hz)
        else:
            self.close()
            self.writer = DriverWriter(
                self._name,
                structure,
                driver_type="calm",
                bus_counters=counters[0],
                patch_counters=counters[1],
                sensor_columns=SENSOR_COLUMNS,
                namespace=self._into,
                rate_hz=rate_hz,
                group=self._group,
                operations=self._operations,
            )
            self.writer.request_server()
            self._counters = counters
        own = set(self.writer.column_offsets()) - {"values", "status"}
        self._copied = sorted(own & set(source.schema.columns))
        self._unknown = sorted(own - set(self._copied))

    def begin(self, frame: DriverSnapshot) -> dict[str, npt.NDArray[Any]] | None:
        """Return the columns of the next sample, all but values and status filled; None while paused."""
        assert self.writer is not None  # noqa: S101 - follow() made it
        try:
            columns = self.writer.begin()
        except Paused:
            return None
        for name in self._copied:
            columns[name][:] = frame.column(name)
        for name in self._unknown:
            columns[name][:] = np.nan if name == "uncertainty" else 0
        return columns

    def publish_stale(self) -> None:
        """Publish the last sample again, all of it stale, as the driver is dead."""
        assert self.writer is not None  # noqa: S101 - there was a frame
        columns = self.writer.begin(from_last=True)
        columns["status"] |= np.uint8(Status.STALE)
        live = columns["patch_state"] == PatchState.LIVE
        columns["patch_state"][live] = PatchState.STALE
        self.writer.commit(now_ns())

    def close(self) -> None:
        if self.writer is not None:
            self.writer.close()
