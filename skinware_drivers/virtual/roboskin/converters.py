"""The capacitance converters of a board, and its firmware's arithmetic: from capacitances to bytes of two CAN frames.

Sources of the rules (facts, no code):

* icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp, ``fill`` and
  ``computedrift`` (MTB4);
* icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_skin_periodic.cpp, ``Message_TRG::get``;
* the older MTB3 application (dsPIC, ``FillCanMessages8bit``), which computes in 16-bit integers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware_drivers.virtual.roboskin.touch import (
    CHANNELS,
    DEFAULT_CDC_OFFSET,
    TRIANGLES,
    ArrayI,
    EmulatedRoboskinOptions,
    Touch,
)

NOT_CONNECTED = 0xFFFF
"""Reading of I2C lines without a chip: the pull-ups."""
NO_ACK = 0
"""Content of the registers after a chip did not acknowledge."""

RAW_TEST = 7
"""The board type that sends the low byte of every capacitance as it is."""
FINGERTIP = 1
"""The board type of palms and fingertips: no thermal compensation."""

_GAINS_FIRST = np.array([70, 96, 83, 38, 38, 70, 0, 45, 77, 164, 0, 77])
_GAINS_SECOND = np.array([58, 91, 39, 23, 35, 90, 0, 38, 68, 115, 0, 86])
_THERMOMETER = slice(6, 7)
_OUT_OF_RANGE_BITS = np.int64(16) << np.arange(CHANNELS)


@dataclass(frozen=True)
class FirmwareSample:
    """Acquisitions of a board as its firmware sees them.

    Attributes:
        values: (n, 16, 12) uint8, as on the wire; lower is more pressure.
        diagnostics: (n, 16) int64, the sixteen bits after the values: 15-4 taxels 11-0 out of range, 1 triangle not
            connected, 0 some channel did not acknowledge.
        no_ack: (n, 16) bool, triangles with a channel that did not acknowledge and is connected.
    """

    values: npt.NDArray[np.uint8]
    diagnostics: ArrayI
    no_ack: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Arithmetic:
    """The arithmetic of a board with its settings, for arrays of the whole board.

    Attributes:
        skin_type: as commanded: 0 compensated, 1 palm and fingertips, 2 not compensated, 3 ergonomic hand,
            7 raw test, 8 compensated with the second set of gains; anything else is not compensated.
        no_load: the value of an untouched taxel, 0-255.
        shift: (16,) bits by which capacitance differences are shifted right.
        mtb3: compute as the older board does: in 16-bit integers, and only types 0 and 1 are compensated.
    """

    skin_type: int
    no_load: int
    shift: tuple[int, ...]
    mtb3: bool

    def sample(self, raw: ArrayI, baseline: ArrayI) -> FirmwareSample:
        """Return values and flags of all triangles.

        Args:
            raw: (n, 16, 12) capacitances of n acquisitions, 0-65535.
            baseline: (16, 12) capacitances at the last calibration.
        """
        if self.skin_type == RAW_TEST:
            nothing = np.zeros(raw.shape[:2], np.int64)
            return FirmwareSample((raw & 0xFF).astype(np.uint8), nothing, nothing.astype(np.bool_))
        value = self._int(raw - baseline - self._drift(raw, baseline))
        values = self.no_load - (value >> self._shifts)
        values[value >= self.bottom] = 0
        values[value <= -self._upper] = 255
        out_of_range = (value <= -self._int(self._upper << 1)) | (value >= self._int(self.bottom << 1))
        not_connected = raw == NOT_CONNECTED
        no_ack = ((raw == NO_ACK) & (baseline != NO_ACK)).any(axis=2)
        diagnostics = out_of_range @ _OUT_OF_RANGE_BITS
        diagnostics |= no_ack
        diagnostics |= not_connected.all(axis=2) * np.int64(2)
        return FirmwareSample(values.astype(np.uint8), diagnostics, no_ack)

    @cached_property
    def bottom(self) -> ArrayI:
        """(16, 1), the difference at which a value reaches 0."""
        return self._int(self.no_load << self._shifts)

    @cached_property
    def _upper(self) -> ArrayI:
        """(16, 1), minus the difference at which a value reaches 255."""
        return self._int((255 - self.no_load) << self._shifts)

    @cached_property
    def _shifts(self) -> ArrayI:
        return np.array(self.shift, np.int64)[:, np.newaxis]

    def _drift(self, raw: ArrayI, baseline: ArrayI) -> ArrayI | int:
        """Return (n, 16, 12), the part of each difference that the firmware takes for warmth."""
        gains = self._gains
        if gains is None:
            return 0
        warmer = raw[..., _THERMOMETER] - baseline[:, _THERMOMETER]
        if self.mtb3:
            # 16-bit unsigned product; the sign comes last (FillCanMessages8bit)
            magnitude = ((np.abs(self._int(warmer)) >> 2) * gains & 0xFFFF) >> 5
            signed: ArrayI = np.where(warmer > 0, magnitude, -magnitude)
            return signed
        # the sign comes before the last shift, which therefore rounds cooling down (computedrift)
        product = (np.abs(warmer) >> 2) * gains
        signed = np.where(warmer > 0, product, -product)
        return signed >> 5

    @cached_property
    def _gains(self) -> ArrayI | None:
        """(16, 12), the compensation of each channel in 1/128; None: there is no compensation.

        Types 1, and 3 in triangles 0-4, have another thermometer (channel 11), but no gains.
        """
        if self.skin_type == 0:
            return np.tile(_GAINS_FIRST, (TRIANGLES, 1))
        if self.skin_type in (3, 8) and not self.mtb3:
            gains = np.tile(_GAINS_SECOND, (TRIANGLES, 1))
            if self.skin_type == 3:
                gains[:5] = 0
            return gains
        return None

    def _int(self, number: ArrayI) -> ArrayI:
        """Return the numbers as the processor's ``int`` holds them."""
        return (number + 0x8000 & 0xFFFF) - 0x8000 if self.mtb3 else number


def triangle_payloads(sample: FirmwareSample, *, short_tail: bool) -> list[list[bytes]]:
    """Return HEAD, TAIL, HEAD ... of all 16 triangles, for each acquisition.

    HEAD is 0x40 and taxels 0-6; TAIL is 0xC0, taxels 7-11 and the diagnostics, high byte first.

    Args:
        short_tail: leave the diagnostics out, as old firmware does.
    """
    block = np.empty((len(sample.values), TRIANGLES, 2, 8), np.uint8)
    block[:, :, 0, 0] = 0x40
    block[:, :, 0, 1:] = sample.values[:, :, :7]
    block[:, :, 1, 0] = 0xC0
    block[:, :, 1, 1:6] = sample.values[:, :, 7:]
    block[:, :, 1, 6] = sample.diagnostics >> 8
    block[:, :, 1, 7] = sample.diagnostics & 0xFF
    places = [(at, 6 if short_tail and at % 16 else 8) for at in range(0, 16 * TRIANGLES, 8)]
    return [[data[at : at + length] for at, length in places] for data in map(np.ndarray.tobytes, block)]


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
