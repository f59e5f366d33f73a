"""What the skin of one board feels: capacitances of whatever presses it (:mod:`.pressed`), and of a warm robot.

Everything is a function of time and seed, so that runs can be repeated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from skinware_drivers.virtual.roboskin.firmware import CHANNELS, TRIANGLES, ArrayI
from skinware_drivers.virtual.roboskin.pressed import PressedSkin

WireSource = Callable[[int, int, int, int], Sequence[int]]
"""(board address, triangle, cycle, time in ns) -> the 12 values that go on the wire, 0-255, whatever is felt."""

DEFAULT_CDC_OFFSET = 0x2200
"""icub-firmware:emBODY/eBcode/arch-arm/board/mtb4/application/src/others/AD7147.c"""

_THERMAL_PADS = (6, 10)
_WARMTH = np.array([70, 96, 83, 38, 38, 70, 128, 45, 77, 164, 128, 77]) / 128
"""How strongly each channel follows the warmth of its triangle; 1 for the thermal pads."""
_WARM_COUNTS, _LUKEWARM_COUNTS = 13, 6
"""A slow wave of warmth and a faster one. Whenever the baseline was taken, values on the wire stay below 255: at the
usual shift of 2 and no load of 240, that is at 60 counts."""
_NOISE_SCALE, _NOISE_LIMIT = 1.8, 4
"""Of the noise, in counts: at most 2 of the values on the wire at a shift of 2, baseline and reading together."""
_NOISE_PERIOD = 61


class Touch:
    """The capacitances of one board.

    Args:
        seed: of the whole patch; boards with different ``ordinal`` feel different things.
        ordinal: of the board in the patch.
        skin: all boards', and what presses it; None for a board that nobody touches.
    """

    def __init__(self, seed: int, ordinal: int, skin: PressedSkin | None = None) -> None:
        random = np.random.default_rng([seed, ordinal])
        self._ordinal, self._skin = ordinal, skin
        self._rest = random.integers(0x8800, 0x9800, (TRIANGLES, CHANNELS))
        noise = random.normal(0, _NOISE_SCALE, (_NOISE_PERIOD, TRIANGLES, CHANNELS))
        self._noise = np.clip(np.rint(noise), -_NOISE_LIMIT, _NOISE_LIMIT).astype(np.int64)
        self._noise[:, :, _THERMAL_PADS] //= 4
        self._warmth_phase = random.uniform(0, 2 * math.pi, (TRIANGLES, 1))
        self._streams = False

    def stream_from(self, time_ns: int | None) -> None:
        """Say when the board began to stream, or (None) that it does not: it lost its power."""
        self._streams = time_ns is not None
        if self._skin is not None:
            self._skin.stream_from(self._ordinal, time_ns)

    @property
    def streams(self) -> bool:
        return self._streams

    @property
    def version(self) -> int:
        """Changes whenever what is felt from now on does, otherwise than with time."""
        return 0 if self._skin is None else self._skin.version

    def capacitances(self, times_ns: ArrayI, cycles: ArrayI, cdc_offset: ArrayI, *, fingertip: bool) -> ArrayI:
        """(n, 16, 12) what the converters read, 1-65534.

        Args:
            times_ns: (n,) of the acquisitions, since anything.
            cycles: (n,) of the board, for the noise.
            cdc_offset: (16, 1) the converters' offset; what it adds is taken off the reading, count for count
                (assumed: the real scale is the converter's affair and vanishes with the next calibration).
            fingertip: all 12 channels feel pressure, and none warmth.
        """
        times_s = times_ns[:, np.newaxis, np.newaxis].astype(np.float64) * 1e-9
        raw: ArrayI = self._rest + self._noise[cycles % _NOISE_PERIOD]
        if self._skin is not None:
            pressure = self._skin.felt(self._ordinal, times_ns)
            if not fingertip:
                pressure[:, :, _THERMAL_PADS] = 0
            raw += pressure
        if not fingertip:
            phase = self._warmth_phase
            warmer = _WARM_COUNTS * np.sin(times_s * (2 * math.pi / 120) + phase)
            warmer += _LUKEWARM_COUNTS * np.sin(times_s * (2 * math.pi / 37) + 2 * phase)
            raw += (warmer * _WARMTH).astype(np.int64)
        raw -= cdc_offset - DEFAULT_CDC_OFFSET
        return np.clip(raw, 1, 0xFFFE, out=raw)


def cycle_pattern(board: int, triangle: int, cycle: int, time_ns: int) -> Sequence[int]:  # noqa: ARG001 - a WireSource
    """A source of which all 12 values of a triangle are the cycle's number modulo 256: torn data shows."""
    return (cycle & 0xFF,) * CHANNELS
