"""Compile kinds of frame, and read those whose values a function of the driver's author reads."""

from __future__ import annotations

import logging
import traceback
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Expand, Frame

log: logging.Logger = logging.getLogger("skinware.driver.expand")

Bytes = npt.NDArray[np.uint8]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class FrameKind:
    """One kind of frame, compiled.

    Attributes:
        channels: (width,) int64, channel of each value; -1 = dropped.
        carries: the channels for which its frames can have values.
        module_by_byte: (n_patches, keys) module that a payload byte names; None: the identifier names it.
    """

    def __init__(self, frame: Frame, tables: SkinTables) -> None:
        self.frame = frame
        self._is_logged = False
        self._dtype = tables.structure.dtype
        n_channels = tables.channel_to_sensor.shape[1]
        self.module_by_byte: Indices | None = None
        if frame.module_byte is not None:
            self.module_by_byte = np.full((tables.structure.n_patches, 1 << frame.module_byte.width), -1, np.int64)
            for (patch, key), module in tables.module_key.items():
                if key < self.module_by_byte.shape[1]:
                    self.module_by_byte[patch, key] = module
        self.channels: Indices
        if isinstance(frame.values, Expand):
            self.channels = np.arange(n_channels)
        else:
            channels = [channel for run in frame.runs for channel in run.channels]
            self.channels = np.array([-1 if c is None else c for c in channels], np.int64)
            self.channels[self.channels >= n_channels] = -1
        to = frame.values.to if isinstance(frame.values, Expand) else None
        self.carries: frozenset[int] = frozenset(self.channels[self.channels >= 0].tolist() if to is None else to)

    def expand(self, expand: Expand, payload: Bytes, length: Bytes) -> tuple[npt.NDArray[Any], Flags, Indices]:
        """Read n frames, payloads (n, size) uint8, by a function of the driver's author.

        Returns:
            (n, width) values; (n, width) bool, which of them the frames have; and the frames for which it raised.
        """
        values = np.zeros((len(payload), len(self.channels)), self._dtype)
        found, failed = np.zeros(values.shape, bool), []
        if not len(payload):
            return values, found, np.zeros(0, np.int64)
        try:
            values, found = self._expand(expand, payload, length)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - it costs only the frame
            if not self._is_logged:
                self._is_logged = True
                log.error(
                    "frame %r: its Expand function raised %s: %s (%s:%d); frames for which it does are not shown, and"
                    " counted as bad content; logged once",
                    self.frame.name,
                    type(error).__name__,
                    str(error),  # so that a kept record refers to no frame of the traceback
                    *traceback.extract_tb(error.__traceback__)[-1][:2],
                )
        else:
            return values, found, np.zeros(0, np.int64)
        # the other frames are read one by one
        for row in range(len(payload)):
            one = slice(row, row + 1)
            try:
                values[one], found[one] = self._expand(expand, payload[one], length[one])
            except (Exception, SystemExit):  # noqa: BLE001
                failed.append(row)
        return values, found, np.array(failed, np.int64)

    def _expand(self, expand: Expand, payload: Bytes, length: Bytes) -> tuple[npt.NDArray[Any], Flags]:
        row, channel, value = expand.function(payload, length)
        if not len(row) == len(channel) == len(value) or value.dtype.kind not in "biuf":
            raise ValueError(f"it returned {len(row)} rows, {len(channel)} channels, {len(value)} {value.dtype} values")
        inside = (channel >= 0) & (channel < len(self.channels))
        row, channel, value = row[inside], channel[inside], value[inside]
        with np.errstate(invalid="ignore"):
            held = value.astype(self._dtype)
        if self._dtype.kind in "iu" and (held != value).any():
            raise ValueError(f"it returned {value[held != value][0]}: the driver's dtype {self._dtype} cannot hold it")
        values = np.zeros((len(payload), len(self.channels)), self._dtype)
        values[row, channel] = held
        found = np.zeros(values.shape, bool)
        found[row, channel] = True
        return values, found


class Assembly:
    """The frames that together make one update of a module, and the sensors of their values.

    Args:
        width: values of every update, whatever it is made of; at least the sum over ``kinds``.
        groups: (n_modules + 1, most) update groups that an update of each module belongs to.
    """

    def __init__(self, kinds: list[FrameKind], tables: SkinTables, width: int, groups: Indices) -> None:
        self.groups = groups
        self.kinds = kinds
        self.channels = np.full(width, -1, np.int64)
        self.columns: list[slice] = []
        end = 0
        for kind in kinds:
            columns = slice(end, end + len(kind.channels))
            self.columns.append(columns)
            self.channels[columns] = kind.channels
            end = columns.stop
        # one column more for what is dropped, one row more for updates that are not shown
        sensors = tables.channel_to_sensor
        table = np.full((len(sensors) + 1, sensors.shape[1] + 1), tables.structure.n_sensors)
        table[:-1, :-1] = sensors
        self.destination = np.ascontiguousarray(table[:, self.channels])
