"""The capacitance converters of a board: their settings, baseline and faults, and the acquisitions of the firmware."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.virtual.roboskin.firmware import (
    CHANNELS,
    FINGERTIP,
    NO_ACK,
    NOT_CONNECTED,
    TRIANGLES,
    Arithmetic,
    ArrayI,
    FirmwareSample,
    triangle_payloads,
)
from skinware_drivers.virtual.roboskin.options import EmulatedRoboskinOptions
from skinware_drivers.virtual.roboskin.touch import DEFAULT_CDC_OFFSET, Touch

DEFAULT_SKIN_TYPE, DEFAULT_NO_LOAD, DEFAULT_SHIFT = 0, 245, 2
"""icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp"""

_LARGEST_SHIFT = 31
_AHEAD = 16
"""Acquisitions that are computed together: numpy takes hardly longer for them than for one."""


_BEYOND_COUNTS = 1024
"""How far a broken taxel is beyond twice the range: more than warmth and noise can compensate."""

TriangleState = Literal["unplugged", "plugged_in", "no_ack", "ack"]
"""A triangle was unplugged or plugged in; its converter stopped or began again to acknowledge."""


class TriangleFaults:
    """The faults of one board's triangles and taxels.

    Attributes:
        disconnected: (16,) bool, triangles whose I2C lines read 0xFFFF.
        not_acknowledging: (16,) bool, triangles whose registers stay 0.
        broken: (16, 12) bool, taxels far out of range.
        version: another number after each :meth:`set_triangle`.
    """

    def __init__(self, options: EmulatedRoboskinOptions, address: int) -> None:
        self.disconnected: npt.NDArray[np.bool_] = np.zeros(TRIANGLES, np.bool_)
        self.not_acknowledging: npt.NDArray[np.bool_] = np.zeros(TRIANGLES, np.bool_)
        self.version: int = 0
        self.broken: npt.NDArray[np.bool_] = np.zeros((TRIANGLES, CHANNELS), np.bool_)
        for board, triangle in options.places("not_connected", 2):
            self.disconnected[triangle] |= board == address
        for board, triangle, taxel in options.places("out_of_range", 3):
            self.broken[triangle, taxel] |= board == address
        fates: tuple[tuple[TriangleState, int], ...] = (
            ("unplugged", options.unplugged_after_cycles),
            ("no_ack", options.no_ack_after_cycles),
        )
        self._coming = [
            (cycle, triangle, fault)
            for fault, cycle in fates
            for board, triangle in options.places(fault, 2)
            if board == address
        ]

    def take_due(self, cycle: int) -> list[tuple[int, TriangleState]]:
        """Apply the faults whose time has come by burst ``cycle``; return them as (triangle, fault)."""
        due = [(triangle, fault) for at, triangle, fault in self._coming if at <= cycle]
        if due:
            self._coming = [coming for coming in self._coming if coming[0] > cycle]
        for triangle, fault in due:
            self.set_triangle(triangle, fault)
        return due

    def set_triangle(self, triangle: int, fault: TriangleState) -> None:
        mask = self.disconnected if fault in ("unplugged", "plugged_in") else self.not_acknowledging
        mask[triangle] = fault in ("unplugged", "no_ack")
        self.version += 1


class Acquisition(NamedTuple):
    time_ns: int
    payloads: list[bytes]
    """HEAD, TAIL, HEAD ... of all 16 triangles."""
    no_ack: npt.NDArray[np.bool_]
    """(16,) triangles with a channel that did not acknowledge."""


class Converters:
    """The 16 converters of a board, with default settings and no baseline.

    Args:
        mtb3: they belong to the older kind of board.
        short_tail: the second frame has no diagnostics.
    """

    def __init__(self, touch: Touch, faults: TriangleFaults, *, mtb3: bool, short_tail: bool) -> None:
        self._touch, self._faults = touch, faults
        self._mtb3, self._short_tail = mtb3, short_tail
        self._skin_type, self._no_load = DEFAULT_SKIN_TYPE, DEFAULT_NO_LOAD
        self._shift = [DEFAULT_SHIFT] * TRIANGLES
        self._cdc_offset = np.full((TRIANGLES, 1), DEFAULT_CDC_OFFSET, np.int64)
        self._baseline: ArrayI = np.zeros((TRIANGLES, CHANNELS), np.int64)
        self._ahead: deque[Acquisition] = deque()
        self._ahead_version = self._version
        self._settings_changed()

    @property
    def _version(self) -> tuple[int, int]:
        """Changes when acquisitions that were computed ahead no longer hold."""
        return self._faults.version, self._touch.version

    def set_board(self, skin_type: int, no_load: int) -> None:
        self._skin_type, self._no_load = skin_type, no_load
        self._settings_changed()

    def set_triangles(
        self, first: int = 0, last: int = TRIANGLES - 1, *, shift: int | None = None, cdc_offset: int | None = None
    ) -> None:
        if shift is not None:
            self._shift[first : last + 1] = [min(shift, _LARGEST_SHIFT)] * (last + 1 - first)
        if cdc_offset is not None:
            self._cdc_offset[first : last + 1] = cdc_offset
        self._settings_changed()

    def calibrate(self, time_ns: int, cycle: int) -> None:
        """Take the readings at ``time_ns`` as the new baseline of all triangles.

        A triangle that is not connected then reads its no-load value and is flagged; one that does not
        acknowledge reads its no-load value and is **not** flagged any more (``fill`` in
        icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp: 0 is an error only
        beside a baseline that is not 0).
        """
        self._baseline = self._read(np.array([time_ns]), np.array([cycle]))[0]
        self._ahead.clear()

    def acquire(self, time_ns: int, cycle: int, period_ns: int) -> Acquisition:
        """Return the acquisition at ``time_ns``; the next call is likely to come one period later."""
        ahead = self._ahead
        if ahead and ahead[0].time_ns == time_ns and self._ahead_version == self._version:
            return ahead.popleft()
        ahead.clear()
        self._ahead_version = self._version
        steps = np.arange(_AHEAD if self._touch.is_known_ahead else 1)
        ahead.extend(self._acquisitions(time_ns + steps * period_ns, cycle + steps, {}))
        return ahead.popleft()

    def acquire_values(self, time_ns: int, cycle: int, values: Mapping[int, Sequence[int]]) -> Acquisition:
        """Return an acquisition with true flags and the given ``values`` (by triangle, 12 of 0-255)."""
        return self._acquisitions(np.array([time_ns]), np.array([cycle]), values)[0]

    def _acquisitions(self, times_ns: ArrayI, cycles: ArrayI, values: Mapping[int, Sequence[int]]) -> list[Acquisition]:
        raw = self._read(times_ns, cycles)
        broken = self._faults.broken
        if broken.any():
            far = np.minimum(self._baseline + 2 * self._arithmetic.bottom + _BEYOND_COUNTS, 0xFFFE)
            raw[:, broken] = far[broken]
        sample: FirmwareSample = self._arithmetic.sample(raw, self._baseline)
        for triangle, twelve in values.items():
            sample.values[:, triangle] = twelve
        payloads = triangle_payloads(sample, short_tail=self._short_tail)
        return [Acquisition(*parts) for parts in zip(times_ns.tolist(), payloads, sample.no_ack, strict=True)]

    def _read(self, times_ns: ArrayI, cycles: ArrayI) -> ArrayI:
        """Return (n, 16, 12), the content of the registers."""
        raw = self._touch.capacitances(times_ns, cycles, self._cdc_offset, fingertip=self._skin_type == FINGERTIP)
        raw[:, self._faults.not_acknowledging] = NO_ACK
        raw[:, self._faults.disconnected] = NOT_CONNECTED
        return raw

    def _settings_changed(self) -> None:
        self._arithmetic = Arithmetic(self._skin_type, self._no_load, tuple(self._shift), self._mtb3)
        self._ahead.clear()
