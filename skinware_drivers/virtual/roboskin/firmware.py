"""The arithmetic of a board's firmware: from sixteen-bit capacitances to the bytes of two CAN frames.

Sources of the rules (facts, no code):

* icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp, ``fill`` and
  ``computedrift`` (MTB4);
* icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_skin_periodic.cpp, ``Message_TRG::get``;
* the older MTB3 application (dsPIC, ``FillCanMessages8bit``), which computes in 16-bit integers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

TRIANGLES = 16
"""Triangles a board can carry."""
CHANNELS = 12
"""Channels of a triangle: one AD7147 capacitance-to-digital converter."""
NOT_CONNECTED = 0xFFFF
"""Reading of I2C lines without a chip: the pull-ups."""
NO_ACK = 0
"""Content of the registers after a chip did not acknowledge."""

RAW_TEST = 7
"""The board type that sends the low byte of every capacitance as it is."""
FINGERTIP = 1
"""The board type of palms and fingertips: no thermal compensation."""

ArrayI = npt.NDArray[np.int64]

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
        sample: of the board.
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
